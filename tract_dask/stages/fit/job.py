"""What the tasks of a fit need: checked, and written for workers."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ...errors import SettingsError
from ...kernels.gaussian.intensity import Floats
from ...kernels.gaussian.model import blurred
from ...kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, X, Y
from ...kernels.magnitude import unit_of
from ...kernels.presence import Filters, matched_filters
from ...kernels.windows import blur_variance
from ...settings.run import FitSettings
from ...settings.toml import from_toml
from ...store import datasets, metadata, results, schema
from ...store.camera import Camera
from ...store.columns import positions
from ...store.journal import left_over
from ...store.movie import Movie
from ...store.provenance import provenance
from ...store.strangers import MOVIE_KEY
from ..columns.slopes import drawn_by_slopes
from ..columns.window_size import neighbour_distance, resolve_blur, resolve_window
from ..pixel_range import check_pixels
from .cells import Cells
from .goodness import Freedom
from .groups import Groups, plan_groups
from .noise_size import WindowNoise, window_noise
from .row_homes import check_frames, sites_of
from .same_atom import Pairs
from .shape_error import ShapeErrors, shape_errors
from .vacuum import check_box, find_vacuum, why_unusable


@dataclass(frozen=True)
class Job:
    """Everything that the fit of a shard needs beside the pixels."""

    columns: xr.Dataset
    """The columns in the summed image (:data:`schema.COLUMNS`)."""
    drift: Floats
    """(frames, 2) measured drift, (y, x), px, of all frames of the movie."""
    bad: NDArray[np.bool_]
    """(frames,) frames that show nothing (:func:`schema.bad_frames`)."""
    window_px: int
    """Side of the windows."""
    vacuum: tuple[int, ...] | None
    """(y0, y1, x0, x1) in the summed image, or None: noise is taken from the residuals."""
    reference_blur_px: float
    """Sigma of the blur that the summed image went through before its fit."""
    refined_by: int | None
    """Fewest accepted columns that may refine a frame's drift; None leaves the drift as measured."""
    settings: FitSettings
    """With the blur that follows the columns, where it was not set."""
    offset: float = 0.0
    """Counts that a pixel without electrons has in the movie."""
    dark_variance: float = 0.0
    """Variance of a pixel without electrons, counts^2, as far as it is known: that of read noise. Negative where the
    offset is larger than was said."""
    correlation: tuple[tuple[float, ...], ...] | None = None
    """Autocorrelation of the pixels' noise; None where pixels share none, or it is not known."""
    unit: float = 1.0
    """Counts in the unit that the reference is in."""
    scale: float = 1.0
    """Of the threshold: with the default one, 5 % of places without a column pass; :mod:`.empty`."""
    left_over: float = 1.0
    """Share of the noise that the residuals of a fit show."""
    lost: tuple[int, ...] = ()
    """Frames that could not be registered."""
    unusable: str | None = None
    """Why the noise of the vacuum is not taken, in words."""
    rounding_variance: float = 0.0
    """What summing by whole pixels adds to the variance of a column, px^2."""
    full_scale: float | None = None
    """Counts at which pixels are cut off; None where they are not."""
    summed: Floats | None = None
    """(columns,) frames that show the column in the summed image; None where it is not known."""
    frame: tuple[int, ...] | None = None
    """(y, x) pixels of a frame; None where it is large enough for any window."""

    def save(self, path: Path, movie: Movie, key: str) -> None:
        """Create the store of results at ``path``, from which :meth:`load` makes the same job."""
        results.create(
            path,
            self.columns.assign({schema.SHAPE_ERROR.name: self.shape_error}),
            self.drift,
            movie.times(),
            movie.shards[0].frames,
            movie.frame_values(),
            rows=None if self.settings.scan_rows == "off" else movie.shape[1],
            **provenance(key, self.settings, str(movie.path)),
            **calibration(movie),
            **{MOVIE_KEY: movie.key},
            part=movie.part,
            window=self.window_px,
            vacuum=self.vacuum,
            vacuum_unusable=self.unusable,
            reference_blur_px=self.reference_blur_px,
            rounding_variance=self.rounding_variance,
            refine_columns=self.refined_by,
            offset=self.offset,
            dark_variance=self.dark_variance,
            correlation=self.correlation,
            threshold_scale=self.scale,
            residual_share=self.left_over,
            shared_place_error=self.shared_place_error,
            lost=list(self.lost),
            motion_centre=self.centre.tolist(),
        )

    @classmethod
    @lru_cache(maxsize=4)
    def load(cls, path: Path, movie: Movie, key: str) -> Job:
        """Return the job that :meth:`save` has written to ``path``; ``key`` tells one fit stage from the next."""
        of_groups = [variable.name for variable in schema.OF_GROUPS]
        columns = datasets.open_dataset(path, only=(*schema.COLUMNS, *of_groups, "drift_measured"))
        about = metadata.attributes(path)
        if about.get("key") != key:
            raise left_over(path, f"key {key}", f"key {about.get('key')}")
        return cls(
            columns,
            columns["drift_measured"].to_numpy(),
            schema.bad_frames(movie.statistics(), math.prod(movie.shape[1:])),
            window_px=about["window"],
            vacuum=tuple(about["vacuum"]) if about["vacuum"] else None,
            reference_blur_px=about["reference_blur_px"],
            rounding_variance=about["rounding_variance"],
            refined_by=about["refine_columns"],
            settings=from_toml(FitSettings, about["settings"], str(path)),
            offset=about["offset"],
            dark_variance=about["dark_variance"],
            correlation=tuple(map(tuple, about["correlation"])) if about["correlation"] else None,
            scale=about["threshold_scale"],
            left_over=about["residual_share"],
            lost=tuple(about["lost"]),
            unusable=about["vacuum_unusable"],
            full_scale=_full_scale(movie),
            frame=movie.shape[1:],
        )

    @cached_property
    def known(self) -> NDArray[np.bool_]:
        """(columns,) whether the column could be fitted on the summed image."""
        known: NDArray[np.bool_] = np.isfinite(self.columns["fit_ref"].to_numpy()).all(axis=1)
        return known

    @cached_property
    def reference(self) -> Floats:
        """(columns, 7) fit on the summed image, as it is in a frame after the blur of the windows, in :attr:`unit`.

        The background has what every pixel of a window has more, so that it is as large as the noise's variance:
        :attr:`dark_variance`.
        What could not be fitted there holds the median shape at the seed's place.
        """
        reference: Floats = self.columns["fit_ref"].to_numpy().astype(np.float64)
        known = self.known
        if not known.any():
            raise SettingsError(
                "no column could be fitted in the summed image",
                "columns",
                "at least one",
                "0",
                "Check the contrast and the seeds",
            )
        reference[~known] = np.median(reference[known], axis=0)
        reference[:, X] = np.where(known, reference[:, X], self.columns["x_ref"].to_numpy())
        reference[:, Y] = np.where(known, reference[:, Y], self.columns["y_ref"].to_numpy())
        more = blur_variance(self.reference_blur_px) + self.rounding_variance
        reference = blurred(reference, blur_variance(self.settings.window_blur_px) - more)
        reference[:, BACKGROUND] += self.dark_variance
        reference[:, [AMPLITUDE, BACKGROUND]] /= self.unit
        return reference

    @cached_property
    def drawn(self) -> Floats:
        """(columns, 2) by how much sloping backgrounds draw fits along x and y, px; 0 for groups."""
        alone = self.known & (self.columns["status_ref"].to_numpy() == 0) & (self.group_numbers == 0)
        return drawn_by_slopes(np.where(alone[:, None], self.reference, np.nan), self.window_px)

    @cached_property
    def centre(self) -> Floats:
        """(x, y) in the summed image, px, about which linear motions are: the middle of all columns."""
        return np.asarray(self.reference[:, [X, Y]].mean(axis=0))

    @cached_property
    def from_centre(self) -> Floats:
        """(columns, 2) places in the summed image as (x, y) from the centre, px."""
        return np.asarray(self.reference[:, [X, Y]] - self.centre)

    @property
    def noise_key(self) -> list[float]:
        """What counts of the camera in the key of the fits; nothing where it is as a counting one."""
        level = [self.offset, self.dark_variance] if self.offset or self.dark_variance else []
        return level + [value for row in self.correlation or () for value in row]

    @property
    def floor(self) -> np.float32:
        """What is subtracted from windows, in :attr:`unit`: what is left is as large as its variance."""
        return np.float32(0 if self.settings.filters_frames else (self.offset - self.dark_variance) / self.unit)

    @property
    def full_scale_in_unit(self) -> float | None:
        """What saturated pixels of windows reach, in :attr:`unit`."""
        return None if self.full_scale is None else self.full_scale / self.unit - float(self.floor)

    @property
    def reach_px(self) -> float:
        """How far a column may be from its place in the summed image, along x and along y, px."""
        return min(self.settings.max_shift_px or self.window_px / 4, self.window_px / 2)

    @cached_property
    def filters(self) -> Filters:
        """The matched filter of each column, by which it is told whether it is there."""
        return matched_filters(self.reference, self.window_px, self.settings.window_blur_px)

    @cached_property
    def cells(self) -> Cells:
        """Where columns may be that have left their places."""
        return Cells(self.reference, self.filters, self.settings.search_px)

    @cached_property
    def near(self) -> Pairs:
        """Pairs of columns whose fits may end on one atom."""
        return Pairs.of(self.reference, self.reach_px)

    @cached_property
    def row_sites(self) -> Floats | None:
        """(columns, ...) sites of the lattice that offsets of scanned rows are measured against, if they are so."""
        if self.settings.scan_rows != "lattice":
            return None
        places = np.where(self.known[:, None], self.reference[:, [Y, X]], np.nan)
        return sites_of(places, schema.texts(self.columns["kind"].to_numpy()))

    def check_rows(self) -> None:
        """Check that columns say where they belong along x, if that is asked for.

        Raises
        ------
        SettingsError
            Where frames are too few for their sum, or the columns make no lattice.
        """
        check_frames(self.settings, int(np.count_nonzero(~self.bad)) - len(self.lost))
        _ = self.row_sites

    @cached_property
    def window_noise(self) -> WindowNoise:
        """What each column's window does with noise."""
        shared = None if self.correlation is None else np.array(self.correlation)
        noise = window_noise(self.reference, self.window_px, self.settings, shared)
        for groups in self.groups:
            noise.left[groups.members], noise.level[groups.members] = groups.left[:, None], groups.level[:, None]
        return noise

    @cached_property
    def counted(self) -> NDArray[np.bool_]:
        """(columns,) whose windows tell how large the noise is: one of each group."""
        counted = np.ones(len(self.reference), np.bool_)
        for groups in self.groups:
            counted[groups.members[:, 1:]] = False
        return counted

    @cached_property
    def freedom(self) -> Freedom:
        """Degrees of freedom of each column's residual: one number for all, or (columns,) where there are groups."""
        alone = self.window_noise.free
        if not self.groups:
            return alone
        values = np.tile(np.array(alone), (len(self.reference), 1))
        for groups in self.groups:
            values[groups.members] = groups.free
        return Freedom(*values.T)

    @cached_property
    def group_numbers(self) -> NDArray[np.int64]:
        """(columns,) number of the group that each column is fitted with; 0: alone."""
        given = self.columns.get(schema.GROUP.name)
        if given is None:
            return np.zeros(self.columns.sizes["column_id"], np.int64)
        return given.to_numpy().astype(np.int64)

    @cached_property
    def groups(self) -> tuple[Groups, ...]:
        """Touching columns, which are fitted together."""
        shared = None if self.correlation is None else np.array(self.correlation)
        return plan_groups(self.group_numbers, self.reference, self.window_px, self.settings, shared, self.frame)

    @cached_property
    def shape_errors(self) -> ShapeErrors:
        """Errors that all frames share, by the columns' shapes in the summed image, over a frame's own."""
        shared = None if self.correlation is None else np.array(self.correlation)
        of_one = shape_errors(
            self.reference, self.window_px, self.groups, self.settings, self.reference_blur_px, shared
        )
        frames = np.full(len(of_one.place), np.nan) if self.summed is None else self.summed
        less = np.sqrt(np.maximum(frames, 1))
        return ShapeErrors(of_one.intensity / less, of_one.place / less[:, None])

    @cached_property
    def shape_error(self) -> xr.Variable:
        """That of the intensity, (columns,); :data:`schema.SHAPE_ERROR`."""
        kind = schema.SHAPE_ERROR
        return xr.Variable(kind.dims, self.shape_errors.intensity, kind.attributes)

    @property
    def shared_place_error(self) -> float | None:
        """Root mean square over touching columns of that of a coordinate; None where none touch, or it is not known."""
        of_touching = self.shape_errors.place[self.group_numbers > 0]
        known = of_touching[np.isfinite(of_touching)]
        return float(np.sqrt(np.square(known).mean())) if known.size else None

    @cached_property
    def in_units(self) -> Job:
        """The same with the reference's counts in the unit that frames are computed in."""
        return replace(self, unit=unit_of(self.reference[:, [AMPLITUDE, BACKGROUND]]))


def prepare(
    movie: Movie,
    columns: xr.Dataset,
    drift: xr.Dataset | None,
    settings: FitSettings,
    *,
    summed: xr.Dataset | None = None,
) -> Job:
    """Return all that the tasks need, checked; see :func:`fit_columns` for the arguments and errors."""
    schema.validate(columns, schema.COLUMNS, "columns")
    shift = schema.drift_of(drift, movie.n_frames)
    blur = resolve_blur(settings.blur_sigma_px, columns)
    settings = replace(settings, blur_sigma_px=blur)
    _check_drift_columns(settings, columns)
    box = settings.vacuum_box
    check_box(box, movie.shape[1:], shift)
    if box is None and summed is not None:
        box = find_vacuum(summed, columns, blur)
    statistics = movie.statistics()
    bad = schema.bad_frames(statistics, math.prod(movie.shape[1:]))
    unusable = why_unusable(movie, box, shift, ~bad) if box else None
    check_pixels(statistics, str(movie.path))
    camera = camera_of(movie, summed)
    if settings.estimator == "poisson" and camera.zero is None and movie.offset == 0 and movie.pixels.dark is None:
        check_counts(statistics["frame_min"].to_numpy())
    job = Job(
        columns,
        shift,
        bad,
        window_px=_window_px(movie, columns, settings),
        vacuum=None if unusable else box,
        unusable=unusable,
        reference_blur_px=columns.attrs.get("blur_sigma_px", blur),
        rounding_variance=columns.attrs.get("rounding_variance_px2", 0.0),
        refined_by=_refined_by(settings, drift),
        settings=settings,
        lost=_lost(drift),
        offset=movie.gain * movie.offset,
        dark_variance=0.0 if settings.filters_frames else dark_variance(movie, camera),
        correlation=camera.correlation if camera.shared.size > 1 else None,
        full_scale=_full_scale(movie),
        summed=_summed_frames(movie, columns, summed, int(np.count_nonzero(~bad)) - len(_lost(drift))),
        frame=movie.shape[1:],
    )
    job.check_rows()
    return job


def _refined_by(settings: FitSettings, drift: xr.Dataset | None) -> int | None:
    """Return the fewest columns that may refine the drift of a frame; None where it stays as it was measured."""
    measured = drift is not None and drift.attrs.get("method") != "none"
    return settings.refine_columns if settings.refine_drift and measured else None


def _window_px(movie: Movie, columns: xr.Dataset, settings: FitSettings) -> int:
    given = settings.window_px or columns.attrs.get("window_px")
    spacing = None if given else neighbour_distance(positions(columns))
    return resolve_window(given, movie.shape[1:], spacing)


def _summed_frames(movie: Movie, columns: xr.Dataset, summed: xr.Dataset | None, usable: int) -> Floats:
    """Return how many frames of the movie show each column in the summed image, (columns,)."""
    if summed is None:
        return np.full(columns.sizes["column_id"], float(usable))
    exposure = summed["exposure"].to_numpy()
    y, x = np.rint(positions(columns)[:, ::-1]).astype(np.int64).T
    inside = np.clip(y, 0, exposure.shape[0] - 1), np.clip(x, 0, exposure.shape[1] - 1)
    return np.asarray(exposure[inside] * (Camera.of(summed.attrs).frames / movie.summed))


def _check_drift_columns(settings: FitSettings, columns: xr.Dataset) -> None:
    known = columns["column_id"].to_numpy()
    if settings.drift_columns is None:
        return
    if not settings.refine_drift:
        raise SettingsError(
            "columns cannot stand still where the drift stays as it was measured",
            "setting drift_columns (FitSettings)",
            "refine_drift",
            "no refine_drift",
            "Leave out one of both",
        )
    if (unknown := sorted(set(settings.drift_columns) - set(known.tolist()))) or not settings.drift_columns:
        raise SettingsError(
            "there are no such columns",
            "setting drift_columns (FitSettings)",
            f"IDs from {known.min()} to {known.max()}",
            ", ".join(map(str, unknown)) or "none",
            "Take the IDs from columns.csv",
        )


def _full_scale(movie: Movie) -> float | None:
    return None if movie.full_scale is None else movie.gain * movie.full_scale


def _lost(drift: xr.Dataset | None) -> tuple[int, ...]:
    """Return the frames whose drift could not be measured; none where it was for no frame, and is zero."""
    quality = np.ones(1) if drift is None else drift["quality"].to_numpy()
    return tuple(np.flatnonzero((quality == 0) & (quality > 0).any()).tolist())


def dark_variance(movie: Movie, camera: Camera) -> float:
    """Return the variance of a pixel without electrons in counts^2; 0 where none is seen for sure."""
    if camera.zero is None or camera.zero_stderr is None or abs(movie.offset - camera.zero) < 3 * camera.zero_stderr:
        return 0.0
    return movie.gain * (movie.offset - camera.zero)


def camera_of(movie: Movie, summed: xr.Dataset | None) -> Camera:
    """Return what the sum of a movie's frames says of the camera, for the frames of this movie."""
    found = Camera.of(None if summed is None else summed.attrs)
    return found.of_sums(movie.summed // found.frames)


def check_counts(smallest: Floats) -> None:
    """Check that the smallest pixels of the frames can be counts.

    Raises
    ------
    SettingsError
        Where one is negative.
    """
    if (smallest < 0).any():
        frame = int(np.nanargmin(smallest))
        raise SettingsError(
            "a pixel is negative, so the frames are not counts",
            "setting estimator (FitSettings)",
            "counts, or a multiple of counts, for poisson",
            f"{smallest[frame]:g} in frame {frame}",
            "Choose the estimator lsq, give the offset (--offset), or convert frames from which nothing was subtracted",
        )


def calibration(movie: Movie) -> dict[str, float | None]:
    """Return what is known of a movie's units."""
    return {"pixel_size_pm": movie.pixel_size_pm, "frame_time_s": movie.frame_time_s, "dose": movie.dose}
