"""What a reader has to know before trusting the tracks, in plain words: each with its numbers and what to do."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from ..settings.run import FitSettings
from ..store.camera import ATTRIBUTE, Camera
from ..store.pixels import KINDS
from ..store.schema import AXES, Status
from ..store.strangers import advice
from .camera import camera_findings, faint_words, fine_columns, free_words, pattern_words
from .crystal import hop_words, left_out_words, motion_words, row_words, same_atom_words, slip_words
from .finding import Finding, count, named
from .odd import BY_CHANCE, LONG, UNLIKE, far_longer, unlike_one
from .survey import Survey
from .touching import alone_words, half_words, shared_words, unresolved_words

LOW_SHARE = 0.9
"""Fewer accepted fits than this share of all that were made are worth a warning."""
WIDE, CLEAR = 0.7, 4.0
"""Diameter of the widest window that is advised, in distances of columns; sigmas between its edge and neighbours."""
HALF = 0.5
"""A column, or a frame, with a smaller share of accepted fits is named."""
AT_BOUND = 0.02
"""Fits that may end on a bound, as a share of all."""
UNSETTLED = 0.01
"""Fits that may fail to converge, as a share of all."""
SHAPES_AT_BOUND = 0.1
FACTOR = 0.8, 1.25
"""Between these, the scatter of the places from frame to frame agrees with the errors of the fits."""
LONG_DRIFT = 0.1
"""A drift over a larger share of the image's side leaves columns near its edges unseen for long."""
LONG_STEP = 0.4
"""A step of the drift beyond this share of the columns' distance may have been mistaken by a whole period."""
POOR_QUALITY = 0.5
"""A frame that correlates with the sum by less than this share of the usual is named."""
RESIDUAL = 0.15
"""Residual of a fit on the summed image, as a share of the amplitude, that is worth a look where noise does not explain
it."""
RIVAL = 0.5
"""Share of the support for one contrast that the other one may have."""
DOUBTFUL, MANY_DOUBTFUL = 0.2, 0.5
"""Share of the columns whose fits on the summed image may be flagged: where the spacing was given, and always."""
NARROW_PX = 0.8
"""Sigma of columns, px, below which the integral over a pixel counts."""
SPACINGS = 0.6, 1.6
"""Distance of the columns, in periods of the image, between which it may be."""
MASKED = 0.01
"""Share of the pixels that the mask may hold: cameras have far fewer faulty ones."""


def findings(run: Survey) -> list[Finding]:
    """Return what there is to know of a run, warnings first."""
    checks = (
        _mixed,
        _calibration,
        _camera,
        _pixels,
        _found,
        _acceptance,
        _columns,
        _frames,
        _flags,
        _errors,
        _drift,
        _crystal,
        _told,
    )
    found = [finding for check in checks for finding in check(run)]
    return sorted(found, key=lambda finding: not finding.serious)


def _mixed(run: Survey) -> Iterator[Finding]:
    if others := run.about.get("strangers"):
        yield Finding(
            "mixed",
            "Stores of two runs",
            f"{' and '.join(others)}: made from another movie than movie.zarr, which lies next to them.",
            f"{advice(run.folder)}.",
        )


def _calibration(run: Survey) -> Iterator[Finding]:
    known = run.tracks.attrs
    if run.known.unit == "px":
        text = "The movie does not say how large a pixel is, so all lengths here are in pixels."
        yield Finding(
            "pixel_size", "The pixel size is not known", text, "Run the same command again with --pixel-size-pm."
        )
    if not known.get("frame_time_s"):
        text = "The movie does not say how long a frame lasts, so time is counted in frames."
        remedy = "Run the same command again with --frame-time-s."
        yield Finding("frame_time", "The frame time is not known", text, remedy, serious=False)


def _camera(run: Survey) -> Iterator[Finding]:
    if ATTRIBUTE not in run.summed.attrs:
        return
    said = {"gain": 1.0, "offset": 0.0} | run.about["movie"]
    image = run.summed["image"].to_numpy()[run.summed["exposure"].to_numpy() > 0]
    level = float(np.median(image)) / said["gain"] + said["offset"] if image.size else 0.0
    camera, arrays = Camera.of(run.summed.attrs), run.left_out.get("arrays", ())
    drift = run.frames["drift_measured"].to_numpy()
    of_columns = fine_columns(run.tracks, drift, run.summed["image"].shape) if camera.fixed_pattern else 0.0
    if words := pattern_words(camera, of_columns):
        yield Finding("gain_pattern", **words)
    for words in camera_findings(camera, said["gain"], said["offset"], level, dark="dark" in arrays):
        yield Finding("camera", **words)


def _pixels(run: Survey) -> Iterator[Finding]:
    """Tell where many pixels carry no data, and which columns miss some."""
    counts, size = run.left_out, run.summed["image"].size
    kinds = [f"{counts[name]:,} {name}" for name in KINDS.values() if name in counts]
    masked = sum(counts.get(name, 0) for name in KINDS.values())
    if masked > MASKED * size:
        text = f"{masked:,} pixels ({masked / size:.1%}) are left out of all frames: {', '.join(kinds)}."
        remedy = "Look at the mask, below. Where it is wrong, run again with --set convert.find_defects=false."
        yield Finding("masked_pixels", "Many pixels carry no data", text, remedy)
    if saturated := counts.get("saturated"):
        frames = counts["frames with saturated pixels"]
        text = (
            f"{count(saturated, 'pixel')} in {count(frames, 'frame')} have the largest value there is, "
            f"{counts['full scale']:g} detector units: what was above is cut off. Fits take them as at least so high; "
            "the errors in these windows are wider."
        )
        remedy = "Record with less beam or shorter frames. Was the file stretched to 8 bits, convert the original."
        yield Finding("saturated", "Pixels are saturated", text, remedy)
    if cut_off := counts.get("cut off"):
        text = (
            f"{count(cut_off, 'pixel')} were saturated before the frames were corrected, or summed in bins: the "
            "recorded pixels have the same highest value again and again. What was above is cut off: heights of these "
            "columns are too small, their widths and intensities too large."
        )
        remedy = (
            "Convert the frames as they were recorded, without --bin, with --gain-reference; or record with less beam."
        )
        yield Finding("saturated", "Pixels are saturated", text, remedy)
    if why := run.about.get("vacuum_unusable"):
        text = f"The vacuum is not used to measure the noise: {why}. The noise is that of the fits' residuals."
        remedy = "Convert frames from which no background was subtracted, or give another --vacuum-box."
        yield Finding("vacuum", "The vacuum does not tell the noise", text, remedy, serious="cut off" in why)
    missing, ids = run.columns["incomplete"].to_numpy(), run.columns["column_id"].to_numpy()
    some = missing > 0
    if some.any():
        most = ids[np.argsort(-missing, kind="stable")][: int(some.sum())]
        text = (
            f"Pixels are missing in {count(int(missing.sum()), 'window')} of {_of_columns(most)}. These fits are made "
            "to the pixels that are there: their stated errors are wider, and where too few are there none is accepted."
        )
        remedy = "Nothing is wrong. A smaller --window-px keeps away from borders and lines without data."
        yield Finding("incomplete", "Some windows miss pixels", text, remedy, serious=False)


def _found(run: Survey) -> Iterator[Finding]:
    """Tell where the columns themselves are in doubt: their contrast, their distance, or most of them."""
    contrast, rival = run.found.get("contrast"), run.found.get("contrast_rival", 0.0)
    if rival > RIVAL:
        other = "dark" if contrast == "bright" else "bright"
        text = f"The summed image speaks for {contrast} columns, and with {rival:.0%} of that for {other} ones."
        remedy = f"Look at the columns in the summed image, and give --contrast {contrast} or --contrast {other}."
        yield Finding("contrast", "Bright or dark columns is not sure", text, remedy)
    status = run.tracks["status_ref"].to_numpy()
    fitted = status[(status & int(Status.OUTSIDE_FRAME)) == 0]
    doubtful = float((fitted != 0).mean()) if len(fitted) else 0.0
    if doubtful > MANY_DOUBTFUL:
        text = (
            f"{int((fitted != 0).sum()):,} of {len(fitted):,} fits on the summed image are flagged: their amplitude is "
            "within the noise, they did not settle, or their shape is that of no other column."
        )
        remedy = "Look at the columns in the summed image. Give --contrast, or --spacing-px, or the columns themselves."
        yield Finding("doubtful_columns", "Most columns are in doubt", text, remedy)
    sigma = run.found.get("sigma_px")
    if sigma and sigma < NARROW_PX:
        text = (
            f"The columns have a sigma of {sigma:.2g} px: too few pixels for their places, which are drawn to the "
            "middles of pixels by thousandths of a pixel."
        )
        remedy = "Record with smaller pixels, or convert without --bin."
        yield Finding("undersampled", "Columns are narrower than the pixels can tell", text, remedy)
    period, apart = run.found.get("lattice_px"), run.found.get("spacing_px")
    given = run.settings.columns.spacing_px if run.settings else None
    too_near = period and given and given < SPACINGS[0] * period and doubtful > DOUBTFUL
    if period and apart and (apart > SPACINGS[1] * period or too_near):
        text = f"The columns are {apart:.3g} px apart, but the summed image repeats itself every {period:.3g} px."
        remedy = "Leave --spacing-px unset, or give the distance between neighbours that the summed image shows."
        yield Finding("spacing", "The distance between columns is not plausible", text, remedy)


def _acceptance(run: Survey) -> Iterator[Finding]:
    if not run.fits or run.accepted >= LOW_SHARE * run.fits:
        return
    reasons = {
        "the amplitude is not above the noise": "below_noise",
        "the fit did not settle": "not_converged",
        "the position or the amplitude ended on its bound": "at_bound",
    }
    numbers = {reason: int(run.columns[flag].sum()) for reason, flag in reasons.items()}
    reason = max(numbers, key=lambda reason: numbers[reason])
    text = (
        f"{run.accepted:,} of {run.fits:,} fits ({run.accepted / run.fits:.1%}) were accepted. The usual reason "
        f"against one: {reason} ({numbers[reason]:,} fits)."
    )
    remedy = "Look at which columns and frames they are, below; sum frames (rebin_frames) where the dose is too low."
    if reason == next(iter(reasons)) and (window := _wider(run)):
        remedy += f" Where nothing else lies between the columns, --window-px {window} tells amplitudes better."
    yield Finding("accepted", "Few fits were accepted", text, remedy)


def _wider(run: Survey) -> int | None:
    """Return the diameter of a window that tells amplitudes better and keeps neighbours out; None where there is none.

    An amplitude is known against its background, and a window of a few sigmas sees little of that.
    """
    apart, sigma = _spacing(run), float(np.nanmedian(run.tracks["fit_ref"].sel(parameter="sigma_a")))
    if not apart or not np.isfinite(sigma):
        return None
    widest = 2 * int(min(WIDE * apart, 2 * (apart - CLEAR * sigma)) / 2) - 1
    return widest if widest > run.tracks.attrs["window_px"] else None


def _columns(run: Survey) -> Iterator[Finding]:
    columns, ids = run.columns, run.columns["column_id"].to_numpy()
    weak = columns["share"].to_numpy() < HALF
    if weak.any():
        text = (
            f"Fewer than half of the fits were accepted for {_of_columns(ids[weak])}. Means over accepted fits of a "
            "faint column are too large: those pass in which noise adds to it."
        )
        remedy = "Is there a column in the summed image? If not, remove it from columns.csv and run again."
        yield Finding("weak_columns", "Some columns are seldom there, or too weak", text, remedy)
    n_frames = run.frames.sizes["frame"]
    outside = columns["outside"].to_numpy()
    never, sometimes = outside == n_frames, (outside > 0) & (outside < n_frames)
    if never.any():
        text = f"The window of {_of_columns(ids[never])} leaves the image in every frame: nothing was fitted."
        remedy = "A smaller window (--window-px) reaches closer to the edge."
        yield Finding("never_fitted", "Columns at the edge were not fitted", text, remedy, serious=False)
    if sometimes.any():
        text = f"The window of {_of_columns(ids[sometimes])} leaves the image in some frames, as the specimen drifts."
        remedy = "Nothing is wrong. A smaller window (--window-px) reaches closer to the edge."
        yield Finding("at_the_edge", "Columns near the edge are missing at times", text, remedy, serious=False)
    poor = (columns["residual"].to_numpy() > RESIDUAL) & ~(columns["p_value"].to_numpy() > BY_CHANCE / len(ids))
    unlike = unlike_one(columns["unlike"].to_numpy(), columns["accepted"].to_numpy())
    long = far_longer(run.tracks)
    if (poor | unlike | long).any():
        seen = {
            f"the fit on the summed image leaves more than {RESIDUAL:.0%} of the amplitude (rms), more than noise does,"
            f" for {_of_columns(ids[poor])}": poor,
            f"more than {UNLIKE:.0%} of the fits leave far more than noise for {_of_columns(ids[unlike])}": unlike,
            f"the summed image shows them more than {LONG:g} times as long as others: {_of_columns(ids[long])}": long,
        }
        text = "; ".join(words for words, which in seen.items() if which.any())
        text = f"{text[:1].upper()}{text[1:]}. A neighbour reaches into the window, or the column is not a Gaussian."
        remedy = (
            "See the residuals below. A smaller window (--window-px) keeps neighbours out. Add a column that is "
            "missing to columns.csv, and run again."
        )
        yield Finding("one_gaussian", "One Gaussian is not enough for some columns", text, remedy)


def _of_columns(ids: NDArray[np.int64]) -> str:
    return f"{count(len(ids), 'column')} ({named(ids.tolist())})"


def _frames(run: Survey) -> Iterator[Finding]:
    frames = run.frames["frame"].to_numpy()
    bad = run.frames["bad"].to_numpy()
    if bad.any():
        which = f"{count(int(bad.sum()), 'frame')} ({named(frames[bad].tolist())})"
        text = f"{which} show nothing: all pixels are equal, or most are missing."
        yield Finding("bad_frames", "Frames could not be fitted", text, "Look at them in the movie.")
    lost = _lost(run) & ~bad
    if lost.any():
        text = (
            f"{count(int(lost.sum()), 'frame')} ({named(frames[lost].tolist())}) do not resemble the others: the "
            "crystal is away, out of focus, or farther than the search. Their drift is interpolated, and no fit of "
            "them is accepted."
        )
        remedy = "Look at them in the movie. Is the crystal there, give --drift-csv or a larger --drift-search-px."
        yield Finding("lost_frames", "Frames are lost", text, remedy)
    poor = ~bad & ~lost & (run.frames["share"].to_numpy() < HALF)
    if poor.any():
        text = (
            f"In {count(int(poor.sum()), 'frame')} ({named(frames[poor].tolist())}) fewer than half of the fits were "
            "accepted."
        )
        remedy = "Is the specimen blurred, out of focus, or out of sight there?"
        yield Finding("poor_frames", "Some frames are worse than the others", text, remedy)


def _lost(run: Survey) -> NDArray[np.bool_]:
    """Return which frames could not be registered."""
    if "quality" not in run.frames:
        return np.zeros(run.frames.sizes["frame"], np.bool_)
    quality = run.frames["quality"].to_numpy()
    return np.asarray((quality == 0) & (quality > 0).any())


def _flags(run: Survey) -> Iterator[Finding]:
    if not run.fits:
        return
    share = {name: int(run.columns[name].sum()) / run.fits for name in ("at_bound", "not_converged", "shape_at_bound")}
    if share["at_bound"] > AT_BOUND:
        text = f"{share['at_bound']:.1%} of all fits ended on a bound of position, amplitude or background."
        remedy = "Columns move farther than --max-shift-px, neighbours are taken for them, or they are not there."
        yield Finding("at_bound", "Many fits ended on a bound", text, remedy)
    if share["not_converged"] > UNSETTLED:
        text = f"{share['not_converged']:.1%} of all fits did not settle."
        steps, usual = run.settings.fit.max_iterations if run.settings else 0, FitSettings().max_iterations
        remedy = (
            f"They were stopped after {steps} steps: run again with --set fit.max_iterations={usual}."
            if 0 < steps < usual
            else "The dose is too low for these columns: sum frames (rebin_frames), or remove what is not a column."
        )
        yield Finding("not_converged", "Many fits did not settle", text, remedy)
    if share["shape_at_bound"] > SHAPES_AT_BOUND:
        text = (
            f"In {share['shape_at_bound']:.1%} of all fits a free width ended on its bound; their places are accepted."
        )
        remedy = "--shape fixed takes the widths of the summed image."
        yield Finding("shape_at_bound", "Widths are not well determined", text, remedy, serious=False)


def _why_no_errors(run: Survey) -> tuple[str, str]:
    """Return why the fits state no errors, and what to do."""
    fit = run.settings.fit if run.settings else None
    if fit is None or fit.filters_frames:
        text = "The fits state no errors of the positions; after the filters wiener and tv-l1 they are not known."
        return text, "Take the spread of columns that keep still, or run again with --filter gaussian."
    about = run.tracks.attrs
    text = (
        f"The fits state no errors of the positions: after a blur of {about['window_blur_px']:g} px too few pixels are "
        f"independent in a window that is {about['window_px']} px across."
    )
    return text, "Take a smaller --blur-sigma-px, a larger --window-px, or a smaller --bin."


def _errors(run: Survey) -> Iterator[Finding]:
    if run.accepted and not np.isfinite(run.columns["expected"]).any():
        yield Finding("no_errors", "No errors are known", *_why_no_errors(run), serious=False)
    number, free = run.columns["accepted"].to_numpy(), run.tracks.attrs.get("shape") == "free"
    if words := free_words(run.scatter, number) if free else faint_words(run.columns["faint"].to_numpy(), number):
        yield Finding("faint", **words)
    if np.isfinite(run.factor) and run.frames.sizes["frame"] > 2 and not FACTOR[0] <= run.factor <= FACTOR[1]:
        more = run.factor > 1
        text = (
            f"From frame to frame the places scatter {run.factor:.2f} times as much as the errors of the fits say "
            "(median over the columns)."
        )
        remedy = (
            "Columns move, drift is left over, or the noise is not that of counts (--gain, --no-counting)."
            if more
            else "The noise is smaller than that of counts: check --gain, or use --no-counting."
        )
        yield Finding("scatter", "The stated errors do not fit the scatter", text, remedy)


def _drift(run: Survey) -> Iterator[Finding]:
    drift = run.frames["drift"].to_numpy()
    side = np.array(run.summed["image"].shape)
    span = np.ptp(drift, axis=0) if len(drift) else np.zeros(2)
    if (span > LONG_DRIFT * side).any():
        axis = int(np.argmax(span / side))
        text = f"Along {AXES[axis]} it spans {span[axis]:.0f} px, {span[axis] / side[axis]:.0%} of the image."
        remedy = (
            "Columns near the edges are seen in part of the frames only. Where that matters, run parts of the movie "
            "(--frames)."
        )
        yield Finding("long_drift", "The drift is long", text, remedy)
    spacing = run.tracks.attrs["window_px"] * 2.0 if (found := _spacing(run)) is None else found
    step = np.hypot(*np.diff(run.frames["drift_measured"].to_numpy(), axis=0).T) if len(drift) > 1 else np.zeros(1)
    if (step > LONG_STEP * spacing).any():
        far = run.frames["frame"].to_numpy()[1:][step > LONG_STEP * spacing]
        text = (
            f"The longest step from one frame to the next is {step.max():.1f} px, with columns {spacing:.0f} px apart: "
            f"it may be wrong by a whole period (frames {named(far.tolist())})."
        )
        yield Finding("long_step", "The drift jumps", text, "Look at these frames, or give the drift (--drift-csv).")
    if "quality" in run.frames:
        quality = run.frames["quality"].to_numpy()
        poor = (quality < POOR_QUALITY * np.nanmedian(quality)) & ~_lost(run)
        if poor.any():
            text = (
                f"{count(int(poor.sum()), 'frame')} ({named(run.frames['frame'].to_numpy()[poor].tolist())}) resemble "
                f"the sum far less than the others (correlation below {POOR_QUALITY * np.nanmedian(quality):.2f})."
            )
            yield Finding("poor_drift", "The drift of some frames is not sure", text, "Look at them in the movie.")


def _spacing(run: Survey) -> float | None:
    """Return the columns' distance from their neighbours, px."""
    from ..stages.columns.window_size import neighbour_distance

    return neighbour_distance(np.stack([run.columns["x_ref"], run.columns["y_ref"]], axis=1))


def _crystal(run: Survey) -> Iterator[Finding]:
    if words := left_out_words(run):
        yield Finding("left_out", **words)
    if words := motion_words(run):
        yield Finding("crystal_motion", **words)
    if words := row_words(run):
        yield Finding("scan_rows", **words)
    if words := slip_words(run):
        yield Finding("moving_columns", **words)
    if words := hop_words(run):
        yield Finding("hopped", **words)
    if words := same_atom_words(run):
        yield Finding("same_atom", **words)
    if words := alone_words(run):
        yield Finding("touching_alone", **words)
    if words := half_words(run):
        yield Finding("one_of_two", **words)
    if words := shared_words(run):
        yield Finding("shared_error", **words)
    if words := unresolved_words(run):
        yield Finding("unresolved", **words)


def _told(run: Survey) -> Iterator[Finding]:
    """Repeat what the last run said itself: it begins where no dashboard is known yet, and says so again with one."""
    starts = [
        number
        for number, event in enumerate(run.events)
        if event.get("event") == "RunStarted" and not event.get("dashboard")
    ]
    for event in run.events[starts[-1] if starts else 0 :]:
        if event.get("event") == "Warned":
            yield Finding(
                "told", "The run said", f"{event['message'][:1].upper()}{event['message'][1:]}.", serious=False
            )
