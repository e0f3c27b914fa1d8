"""The page: numbers, findings and figures put into one HTML file that needs nothing else."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from matplotlib.figure import Figure
from numpy.typing import NDArray

from .. import plots
from ..analysis.jumps import change_points
from ..errors import TractError
from ..settings.declare import Settings
from ..settings.run import RunSettings
from ..stages.convert.defects import FEWEST_FRAMES
from ..store import files, metadata
from ..store.keys import digest_of
from ..store.pixels import in_words, pixels_of
from ..store.results import part_in_words
from ..store.run_folder import RunFolder
from ..web import bundle
from ..web.bundle import STATIC
from . import interactive
from .finding import count
from .findings import RESIDUAL, findings
from .pictures import MASK_COLOURS, figure_data, mask_data, windows_data
from .residuals import residual_windows
from .survey import Survey, events_of, median, percentiles, survey

_SCRIPT = Path(__file__).parent / "page.js"
KEY = '<meta name="tract-dask-key" content="'
_FIGURE_DPI = 110
_WORST = 6
"""Columns whose residuals are shown, and which are named in the table of those worth a look."""
_JUMP_WORK = 8e8
"""Change points are looked for where columns times the square of the frames is no more: about a second."""
_JUMP_CONFIDENCE = 0.99
_KIND_WORDS = {"lines": "in lines"}


@dataclass(frozen=True)
class Picture:
    """A figure on the page."""

    title: str
    caption: str
    data: str


def write_report(folder: str | Path, path: str | Path | None = None, *, figures: bool = True) -> Path:
    """Write what a run measured, and how well, as one HTML file.

    The file holds its figures, its data and its scripts: it needs neither other files nor a network. The series of the
    columns are averaged until they fit into about 4 MB.

    Parameters
    ----------
    folder
        Of a finished run.
    path
        The file; None: ``report.html`` in the folder.
    figures
        With maps of spread, tracks, widths and jumps, which take most of the time.

    Returns
    -------
    Path
        The file.

    Raises
    ------
    StoreError
        Where the folder has no finished tracks or no summed image, or the file cannot be written.
    """
    folder = Path(folder)
    place = RunFolder(folder).report if path is None else Path(path)
    write_page(survey(folder, events_of(RunFolder(folder).events)), run_key(folder), place, figures=figures)
    return place


def write_page(run: Survey, key: str, place: Path, *, figures: bool) -> None:
    """Write the page of a run that was looked at; ``key`` is that of :func:`run_key`."""
    files.write_aside(place, render(run, key, figures=figures).encode(errors="backslashreplace"))


def is_current(folder: Path) -> bool:
    """Tell whether the folder's report is of the tracks that are in it now."""
    try:
        with RunFolder(folder).report.open(encoding="utf-8") as file:
            return f"{KEY}{run_key(folder)}" in file.read(2000)
    except OSError:
        return False


def run_key(folder: Path) -> str:
    """Return the key of what is said of a run: all that the tracks say of themselves, and the settings of the run."""
    about = {k: v for k, v in metadata.attributes(RunFolder(folder).results).items() if k != "findings"}
    settings = RunFolder(folder).settings
    return digest_of(json.dumps(about, sort_keys=True), settings.read_bytes() if settings.exists() else b"")


def render(run: Survey, key: str = "", *, figures: bool = True) -> str:
    """Return the page."""
    first, shades = first_column(run), interactive.shades(run)
    image, about_image = interactive.image_data(run)
    data = interactive.page_data(run, first) | {"image": about_image}
    loader = Environment(
        loader=PackageLoader("tract_dask", "report"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return loader.get_template("template.html").render(
        key=key,
        title=Path(_source(run)).name,
        folder=str(run.folder),
        cards=cards(run),
        findings=findings(run),
        quality=quality(run),
        theme_script=Markup((STATIC / "theme.js").read_text(encoding="utf-8")),
        shared_style=Markup(
            "".join((STATIC / name).read_text(encoding="utf-8") for name in ("theme.css", "charts.css"))
        ),
        script=Markup(bundle(_SCRIPT)),
        data=Markup(interactive.script_json(data)),
        image=image,
        aspect=round(min(2.0, max(0.5, about_image["width"] / about_image["height"])), 3),
        shades=shades,
        shown={shade.name for shade in shades},
        ids=run.columns["column_id"].to_numpy().tolist(),
        first=first,
        frames_a_point=run.series.attrs["frames"],
        worst=worst_columns(run),
        residual_limit=RESIDUAL,
        windows=_windows(run),
        mask=mask_picture(run),
        pictures=list(_pictures(run)) if figures else [],
        unit=run.known.unit,
        measured=measured(run),
        changed=[row for group in settings_rows(run.settings).values() for row in group if row["changed"]],
        settings=settings_rows(run.settings),
        stages=stages(run),
        versions=run.about.get("versions", {}),
    )


def _source(run: Survey) -> str:
    """Return the movie's path."""
    return str(run.about["movie"].get("source") or run.about.get("source") or run.folder)


def cards(run: Survey) -> list[tuple[str, str, str]]:
    """Return the numbers that stand on top: a name, a value, and what belongs to it."""
    columns, unit = run.columns, run.known.unit
    spread, expected = median(columns["spread"]), median(columns["expected"])
    drift = run.known.scale * np.ptp(run.frames["drift"].to_numpy(), axis=0)
    n_frames = run.frames.sizes["frame"]
    frame_time = run.tracks.attrs.get("frame_time_s")
    last = float(run.frames["time"][-1])  # of which frames were lost, or a part was read, their number does not tell
    lasting = f"{last + frame_time:.4g} s" if frame_time else "frame time not known"
    fitted = int((columns["fits"] > 0).sum())
    return [
        ("Frames", f"{n_frames:,}", lasting),
        ("Columns", f"{columns.sizes['column_id']:,}", f"{fitted:,} of them fitted"),
        ("Fits accepted", _percent(run.accepted, run.fits), f"{run.accepted:,} of {run.fits:,}"),
        ("Spread", _number(spread, unit), f"median per axis; stated error {_number(expected, unit)}"),
        ("R²", _number(median(columns["r_squared"])), "median of the columns' means"),
        ("Drift", _lengths(drift[::-1], unit), "range along x and y"),
    ]


def quality(run: Survey) -> list[str]:
    """Return how good the tracks are, as sentences."""
    columns, n_frames = run.columns, run.frames.sizes["frame"]
    said = [
        f"{run.accepted:,} of {run.fits:,} fits were accepted ({_percent(run.accepted, run.fits)}); "
        f"{int((columns['share'] >= 0.9).sum())} of {count(columns.sizes['column_id'], 'column')} are accepted in at "
        "least nine frames of ten."
    ]
    if np.isfinite(columns["spread"]).any():
        spread, expected = median(columns["spread"]), median(columns["expected"])
        error = f"an error of {_number(expected, run.known.unit)}" if np.isfinite(expected) else "no error"
        said.append(
            f"A column spreads by {_number(spread, run.known.unit)} per axis (median over the columns); the fits state "
            f"{error}."
        )
    if np.isfinite(run.factor) and n_frames > 2:
        said.append(
            f"From frame to frame the places scatter {run.factor:.2f} times as much as stated; 1 means that the errors "
            "are right."
        )
    if np.isfinite(columns["r_squared"]).any():
        low, high = percentiles(columns["r_squared"])
        said.append(
            f"A fit explains {median(columns['r_squared']):.0%} of the variance in its window (R², median; columns "
            f"from {low:.0%} to {high:.0%}). The rest is mostly counting noise where the dose is low."
        )
    if np.isfinite(columns["residual"]).any():
        said.append(
            f"On the summed image the fits leave {median(columns['residual']):.1%} of the amplitude (rms, median), "
            f"and {float(np.nanmax(columns['residual'])):.1%} for the worst column."
        )
    outside = columns["outside"].to_numpy()
    said.append(
        f"The window of {count(int((outside > 0).sum()), 'column')} leaves the image in some or all frames."
        if (outside > 0).any()
        else "All windows stay inside the image in every frame."
    )
    bad = int(run.frames["bad"].sum())
    said.append(f"{count(bad, 'frame')} could not be fitted: they show nothing." if bad else "No frame is bad.")
    return said


def first_column(run: Survey) -> int:
    """Return the place of the column that is shown first: the one that moves most against its stated error."""
    excess = np.where(run.columns["share"] >= 0.5, run.columns["excess"], np.nan)
    return int(np.nanargmax(excess)) if np.isfinite(excess).any() else 0


def worst_columns(run: Survey) -> list[dict[str, Any]]:
    """Return the columns that are worth a look: few accepted fits, a large residual, a spread beyond the errors."""
    columns = run.columns
    rank = {
        "few accepted fits": -np.nan_to_num(columns["share"].to_numpy(), nan=0.0),
        "large residual": np.nan_to_num(columns["residual"].to_numpy(), nan=-np.inf),
        "spread beyond its error": np.nan_to_num(columns["excess"].to_numpy(), nan=-np.inf),
    }
    reasons: dict[int, list[str]] = {}
    for reason, badness in rank.items():
        for k in np.argsort(-badness, kind="stable")[: _WORST // 2]:
            if np.isfinite(badness[k]):
                reasons.setdefault(int(k), []).append(reason)
    rows = []
    for k, why in reasons.items():
        own = columns.isel(column_id=k)
        rows.append(
            {
                "place": k,
                "id": int(own["column_id"]),
                "kind": str(own["kind"].item()) or "-",
                "why": ", ".join(why),
                "share": _percent(int(own["accepted"]), int(own["fits"])),
                "residual": f"{float(own['residual']):.1%}" if np.isfinite(own["residual"]) else "-",
                "p_value": f"{float(own['p_value']):.2g}" if np.isfinite(own["p_value"]) else "-",
                "spread": _number(float(own["spread"]), run.known.unit),
                "expected": _number(float(own["expected"]), run.known.unit),
                "r_squared": _number(float(own["r_squared"])),
            }
        )
    return rows


def _windows(run: Survey) -> list[dict[str, Any]]:
    """Return image, model and residual of the columns with the largest residuals."""
    share = run.columns["residual"].to_numpy()
    order = [k for k in np.argsort(-np.nan_to_num(share, nan=-1.0), kind="stable")[:_WORST] if np.isfinite(share[k])]
    ids = run.columns["column_id"].to_numpy()
    return [
        {"id": int(ids[k]), "share": f"{share[k]:.1%}", "data": windows_data(shown)}
        for k, shown in zip(order, residual_windows(run.tracks, run.summed, order), strict=True)
    ]


def _pictures(run: Survey) -> Iterator[Picture]:
    """Yield the figures that the tracks allow."""
    if run.known.unit == "px":
        return
    tracks, summed = run.tracks, run.summed
    makers: list[tuple[str, str, Callable[[], Figure]]] = []
    if run.frames.sizes["frame"] > 1:
        text = "Standard deviation of the place per axis, from the fits and from centroids, on the summed image."
        makers.append(("Spread", text, lambda: plots.plot_spread(tracks, summed)))
        text = "Tracks about the mean places, enlarged, and in time for the four columns that spread most."
        makers.append(("Tracks", text, lambda: plots.plot_tracks(tracks, summed)))
    text = "Full width at half maximum in the summed image, without the blur before the fit."
    makers.append(("Width", text, lambda: plots.plot_fwhm(tracks, summed)))
    if tracks.sizes["frame"] > 2 and tracks.sizes["frame"] ** 2 * tracks.sizes["column_id"] <= _JUMP_WORK:
        text = f"Jumps by the change-point test at {_JUMP_CONFIDENCE:.0%} confidence for each column."
        makers.append(
            ("Jumps", text, lambda: plots.plot_jumps(change_points(tracks, _JUMP_CONFIDENCE), tracks, summed))
        )
    for title, text, make in makers:
        try:
            yield Picture(title, text, figure_data(make(), _FIGURE_DPI))
        except TractError as error:
            yield Picture(title, f"This figure could not be made: {error}", "")


def mask_picture(run: Survey) -> Picture | None:
    """Return which pixels are left out of all frames; None where none are, or the movie is gone or damaged."""
    if "mask" not in run.left_out.get("arrays", ()):
        return None
    try:
        mask = pixels_of(RunFolder(run.folder).movie, run.about["movie"]["key"]).mask
    except TractError:
        return None
    if mask is None:
        return None
    colours = ((name, colour.removeprefix("tab:")) for name, colour in MASK_COLOURS.items() if name in run.left_out)
    kinds = [f"{colour}: {run.left_out[name]:,} {_KIND_WORDS.get(name, name)}" for name, colour in colours]
    caption = f"Pixels that are left out of all frames. {', '.join(kinds)}. A pixel is drawn larger than it is."
    return Picture("Mask", caption, mask_data(mask))


def _left_out(run: Survey) -> str:
    """Return in words which pixels carry no data."""
    if run.settings and not run.settings.convert.find_defects:
        return "not looked for (find_defects is off)"
    found = in_words(run.left_out)
    if run.frames.sizes["frame"] < FEWEST_FRAMES:
        found.append(f"dead pixels and lines are not looked for in fewer than {FEWEST_FRAMES} frames")
    return ", ".join(found) or "none found"


def measured(run: Survey) -> list[tuple[str, str]]:
    """Return what was measured: names and values."""
    known, movie = run.tracks.attrs, run.about["movie"]
    shape = movie.get("shape") or [run.frames.sizes["frame"], *run.summed["image"].shape]
    kinds = sorted({str(kind) for kind in run.columns["kind"].to_numpy()} - {""})
    rows = {
        "Movie": _source(run),
        "Format": movie.get("source_format"),
        "Frames": f"{shape[0]:,} of {shape[2]:,} × {shape[1]:,} px ({movie.get('dtype', 'dtype not known')})",
        "Pixels without data": _left_out(run),
        "Part of the source": part_in_words(movie.get("part")),
        "Size of a pixel": f"{known['pixel_size_pm']:g} pm" if run.known.unit == "pm" else "not known",
        "Field of view": f"{shape[2] * run.known.scale / 1000:.3g} × {shape[1] * run.known.scale / 1000:.3g} nm"
        if run.known.unit == "pm"
        else None,
        "Time of a frame": f"{known['frame_time_s']:g} s" if known.get("frame_time_s") else "not known",
        "Dose of a frame": f"{known['dose']:g} e/Å²" if known.get("dose") else "not known",
        "Counts for one detector unit": f"{movie['gain']:g}" if "gain" in movie else None,
        "Columns": f"{run.columns.sizes['column_id']:,}" + (f" ({', '.join(kinds)})" if kinds else ""),
        "Window of a fit": f"{known['window_px']} px across",
        "Blur before the fit": f"{known['window_blur_px']:g} px" if known.get("window_blur_px") else None,
        "Fitted by": {"lsq": "least squares on filtered pixels", "poisson": "maximum likelihood of counts"}.get(
            known["estimator"], known["estimator"]
        )
        + (", shapes as in the summed image" if known["shape"] == "fixed" else ", shapes free in every frame"),
        "Tracked at": _readable_time(run.about.get("created")),
        "Folder": str(run.folder.absolute()),
    }
    return [(name, value) for name, value in rows.items() if value]


def settings_rows(settings: RunSettings | None) -> dict[str, list[dict[str, Any]]]:
    """Return every setting by its group: name, value, default, unit, what it means, and whether it was changed."""
    if settings is None:
        return {}
    groups: dict[str, list[dict[str, Any]]] = {}
    for group in dataclasses.fields(settings):
        values, rows = getattr(settings, group.name), []
        for item in dataclasses.fields(values):
            value = getattr(values, item.name)
            if isinstance(value, Settings):
                continue
            rows.append(
                {
                    "name": f"{group.name}.{item.name}",
                    "value": _setting(value),
                    "default": _setting(item.default),
                    "unit": item.metadata["unit"],
                    "meaning": item.metadata["description"],
                    "changed": value != item.default,
                }
            )
        groups[group.name] = rows
    return groups


def stages(run: Survey) -> list[tuple[str, str, str]]:
    """Return what was done when: stage, time, and how long it took, the last time that it was done."""
    done = {
        event["stage"]: (event["time"], event["seconds"], event.get("summary", ""))
        for event in run.events
        if event.get("event") == "StageDone" and not event.get("reused")
    }
    return [
        (stage, _readable_time(when) or "", f"{seconds:.1f} s{f' ({summary})' if summary else ''}")
        for stage, (when, seconds, summary) in done.items()
    ]


def _setting(value: Any) -> str:
    if value is None or value == ():
        return "unset"
    if isinstance(value, bool):
        return "on" if value else "off"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _readable_time(text: str | None) -> str | None:
    return f"{datetime.fromisoformat(text):%Y-%m-%d %H:%M} UTC" if text else None


def _percent(part: int, whole: int) -> str:
    return f"{part / whole:.1%}" if whole else "-"


def _number(value: float, unit: str = "") -> str:
    """Return a number with three digits and its unit; a dash where it is not known."""
    return f"{value:.3g} {unit}".strip() if np.isfinite(value) else "-"


def _lengths(values: NDArray[np.float64], unit: str) -> str:
    """Return lengths in their unit; those in pm in nm where one of them is as long."""
    if unit == "pm" and values.max() >= 1000:
        values, unit = values / 1000, "nm"
    return f"{' × '.join(f'{value:.3g}' for value in values)} {unit}"
