"""Detection: what stands out of the noise like a column, in the summed image, or frame by frame.

Unlike :func:`tract_dask.stages.columns.lattice.find_peaks` these methods know nothing of a lattice. Each makes of the
image a map of strengths, in units of what white noise alone shows there, of which the local maxima are taken:

- ``maxima``: the height above the surroundings after a blur of the columns' size
  (:func:`tract_dask.stages.columns.relief.relief`);
- ``blobs``: the negative Laplacian of a Gaussian at several scales, of each pixel the highest (Lindeberg, Int. J.
  Comput. Vis. 30 (1998) 79);
- ``template``: the correlation coefficient r with the picture of a column (Lewis 1995, as in
  ``skimage.feature.match_template``), times sqrt(N - 1) for a template of N pixels. It knows shapes, not amplitudes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from distributed import Client
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from ...cluster.stage_run import StageRun
from ...errors import InputError, SettingsError
from ...kernels.magnitude import unit_of
from ...kernels.peaks import centroids, local_maxima
from ...progress import Sink, silent
from ...settings.run import ColumnSettings
from ...store import schema
from ...store.arrays import load_saved, save_array
from ...store.columns import column_dataset, positions
from ...store.journal import Payload
from ...store.keys import stage_key
from ...store.movie import Movie
from ...store.shards import Shard
from .contrast import SIGNS, chosen
from .lattice import find_lattice
from .relief import Mask, Places, Reals, Relief, binned, pixel_noise, relief
from .window_size import default_window

METHODS = ("maxima", "blobs", "template")

_APART = 1 / 3
"""Of two maxima nearer than this share of the spacing only the stronger one counts."""
_SCALES = (0.06, 0.085, 0.12)
"""Sigmas of the blobs, in units of the spacing: a column's is about a tenth."""
_BINS_PER_SPACING = 24
_STRONGEST = 0.95
"""Quantile of the strengths that ``min_amplitude`` is held against."""
_MODELS = 50
"""A template is the mean of so many of the strongest columns, or of a quarter of them if they are fewer."""
_FIELDS = ("frame", "y", "x", "strength")


@dataclass(frozen=True)
class Detector:
    """A method with all that it needs to know.

    Attributes
    ----------
    method
        One of :data:`METHODS`.
    spacing_px
        Distance between neighbouring columns.
    threshold
        Smallest strength, in units of the noise.
    min_amplitude
        Smallest strength against the strongest ones (their 0.95 quantile) of the same image.
    sign
        1 for bright columns, -1 for dark ones.
    blur_sigma_px
        Least blur before maxima are looked for; None: what suits the spacing.
    template
        (y, x) picture of a column, bright, on bins as :meth:`step` says; for method ``template``.
    """

    method: str
    spacing_px: float
    threshold: float
    min_amplitude: float = 0.0
    sign: int = 1
    blur_sigma_px: float | None = None
    template: Reals | None = None

    @property
    def step(self) -> int:
        """Pixels in a bin: columns are looked for on 24 bins a spacing or more."""
        return max(1, int(self.spacing_px / _BINS_PER_SPACING))

    def __call__(self, image: Reals, valid: Mask) -> tuple[Places, Reals]:
        """Return the places of what it finds in an image (y, x), and the strengths, strongest first."""
        bright = self.sign * _filled(image, valid)
        noise = pixel_noise(bright, valid)
        make = {"maxima": self._relief, "blobs": self._blobs, "template": self._likeness}[self.method]
        raised = make(bright, valid, noise)
        apart = max(_APART * self.spacing_px / raised.step, 1.5)
        peaks = local_maxima(raised.height, apart, max(self.threshold * raised.noise, np.finfo(np.float32).tiny))
        x, y = peaks.astype(np.int64).T
        inside = ndimage.binary_erosion(raised.valid)[y, x]
        strength = raised.height[y, x][inside] / (raised.noise or 1.0)
        order = np.argsort(-strength, kind="stable")
        if len(order):
            order = order[strength[order] >= self.min_amplitude * np.quantile(strength, _STRONGEST)]
        radius = max(self.spacing_px / 8 / raised.step, 1.5)
        return raised.px(centroids(raised.height, peaks[inside][order], radius)), strength[order]

    def _relief(self, image: Reals, valid: Mask, noise: float) -> Relief:
        return relief(image, valid, noise, self.spacing_px, self.blur_sigma_px)

    def _blobs(self, image: Reals, valid: Mask, noise: float) -> Relief:
        """White noise of standard deviation s has a Laplacian of Gaussian of s / (sqrt(2 pi) sigma^3)."""
        bins = binned(image, self.step).astype(np.float32)
        height = np.full(bins.shape, -np.inf, np.float32)
        for scale in _SCALES:
            sigma = max(1.0, scale * self.spacing_px / self.step)
            response = ndimage.gaussian_laplace(bins, sigma, mode="nearest")
            np.maximum(height, -np.sqrt(2 * np.pi) * sigma**3 * response, out=height)
        return Relief(height, binned(valid, self.step) == 1, noise / self.step, self.step)

    def _likeness(self, image: Reals, valid: Mask, noise: float) -> Relief:
        from skimage.feature import match_template  # takes its time, and only this method needs it

        assert self.template is not None
        likeness = match_template(binned(image, self.step), self.template, pad_input=True, mode="edge")
        height = np.sqrt(self.template.size - 1) * likeness
        return Relief(height.astype(np.float32), binned(valid, self.step) == 1, 1.0, self.step)


def make_detector(
    image: Reals, valid: Mask, settings: ColumnSettings, *, blur_sigma_px: float | None = None
) -> Detector:
    """Return the detector of the settings; what they leave open, the spacing and the template, is taken from an image.

    Raises
    ------
    InputError
        Where the image shows no lattice and no spacing is given, or nothing to make a template of.
    SettingsError
        Where the method is none of this room's, or the template does not lie in the image.
    """
    if settings.method not in METHODS:
        raise SettingsError(
            "this method does not detect", "setting method (ColumnSettings)", " or ".join(METHODS), settings.method
        )
    if settings.contrast == "auto":
        settings = replace(settings, contrast=_clearer(image, valid, settings, blur_sigma_px))
    sign = SIGNS[settings.contrast]
    spacing = settings.spacing_px
    if spacing is None:
        bright = sign * _filled(image, valid)
        lattice = find_lattice(bright, valid, pixel_noise(bright, valid), blur_sigma_px)
        if lattice is None:
            raise InputError(
                "the image shows no lattice, so the distance between columns is not known",
                "columns",
                "a periodic image, or a spacing",
                "none of its shifts matches it",
                "Give spacing_px",
            )
        spacing = lattice.spacing
    maxima = Detector("maxima", spacing, settings.detection_threshold, settings.min_amplitude, sign, blur_sigma_px)
    template = _template(image, valid, maxima, settings.template) if settings.method == "template" else None
    return replace(maxima, method=settings.method, template=template)


def _clearer(image: Reals, valid: Mask, settings: ColumnSettings, blur_sigma_px: float | None) -> str:
    """Return the contrast of which more stands out: by the squares of the maxima's strengths, without outlying ones."""
    powers = dict.fromkeys(SIGNS, 0.0)
    for contrast in SIGNS if valid.any() else ():
        maxima = replace(settings, method="maxima", contrast=contrast)
        strengths = make_detector(image, valid, maxima, blur_sigma_px=blur_sigma_px)(image, valid)[1]
        if len(strengths):
            powers[contrast] = float((np.minimum(strengths, 2 * np.median(strengths)) ** 2).sum())
    return chosen(powers)[0]


def _template(image: Reals, valid: Mask, maxima: Detector, at: tuple[int, ...] | None) -> Reals:
    """Return a column's picture on bins: that at the place ``at`` (x, y), or the mean of the strongest ones."""
    bins = maxima.sign * binned(_filled(image, valid), maxima.step)
    exposed = binned(valid, maxima.step) == 1
    half = default_window(maxima.spacing_px / maxima.step) // 2
    if at is not None and len(at) != 2:
        raise SettingsError("template needs x,y in px", "setting template (ColumnSettings)", "two numbers", str(at))
    places = maxima(image, valid)[0] if at is None else np.array([at], np.float64)
    corner = np.rint((places + 0.5) / maxima.step - 0.5).astype(np.int64) - half
    size = 2 * half + 1
    pictures = [
        bins[y : y + size, x : x + size]
        for x, y in corner.tolist()
        if min(x, y) >= 0
        and exposed[y : y + size, x : x + size].shape == (size, size)
        and exposed[y : y + size, x : x + size].all()
    ]
    if not pictures:
        raise InputError(
            "there is no column to make the template of",
            "setting template (ColumnSettings)",
            f"a column {half * maxima.step} px or more from the rim of the image",
            "none" if at is None else f"{tuple(at)}",
            "Name a column by its place, or lower detection_threshold",
        )
    count = min(_MODELS, -(-len(pictures) // 4))
    return np.asarray(np.mean(pictures[:count], axis=0))


def detect_columns(
    source: Movie | xr.Dataset | ArrayLike,
    method: str = "maxima",
    *,
    settings: ColumnSettings | None = None,
    drift: xr.Dataset | None = None,
    blur_sigma_px: float | None = None,
    client: Client | None = None,
    on_event: Sink = silent,
    journal: Path | None = None,
) -> xr.Dataset:
    """Return what stands out of the noise like a column: in an image, or in each frame of a movie by itself.

    Parameters
    ----------
    source
        A movie, a summed image (:data:`schema.SUM`), or a single image (y, x).
    method
        ``maxima``, ``blobs`` or ``template``, see the head of this module.
    settings
        ``spacing_px`` (of a movie, unset: measured in the mean of its first frames, as the template is), ``template``,
        ``contrast``, ``detection_threshold``, ``min_amplitude``; the others do not matter.
    drift
        Of the movie: places are then drift-corrected, in px of the summed image.
    blur_sigma_px
        Least blur before maxima are looked for, px; None: what suits the spacing.
    client, on_event, journal
        As for :func:`tract_dask.sum_image`; a movie is worked through shard by shard.

    Returns
    -------
    Dataset
        Over detection, in the order of the frames and strongest first in each: ``frame``, ``y``, ``x`` (px),
        ``strength`` (in units of the noise). Attributes: method, spacing_px, n_frames, shape, pixel_size_pm.

    Raises
    ------
    InputError, SettingsError
        As :func:`make_detector`; and where the drift is of another movie.
    """
    settings = replace(settings or ColumnSettings(min_amplitude=0.0), method=method)
    about: dict[str, Any] = {"method": method, "n_frames": 1, "pixel_size_pm": None}
    if isinstance(source, Movie):
        shift = schema.drift_of(drift, source.n_frames)
        first = source.read(0, min(source.layer_frames, source.n_frames)).astype(np.float64).mean(axis=0)
        detector = make_detector(*_masked(first), settings, blur_sigma_px=blur_sigma_px)
        found = _in_movie(source, detector, shift, client, on_event, journal)
        about |= {"n_frames": source.n_frames, "pixel_size_pm": source.pixel_size_pm, "shape": source.shape[1:]}
    else:
        if isinstance(source, xr.Dataset):
            schema.validate(source, schema.SUM, "summed image")
            image, valid = source["image"].to_numpy(), source["exposure"].to_numpy() > 0
            about["pixel_size_pm"] = source.attrs.get("pixel_size_pm")
        else:
            image, valid = _masked(_image(source))
        detector = make_detector(image, valid, settings, blur_sigma_px=blur_sigma_px)
        found, about["shape"] = _rows(detector, image, valid, 0), image.shape
    frame, y, x, strength = found.T
    values = {
        "frame": (frame.astype(np.int64), "1", "Frame"),
        "y": (y, "px", "Place" + (", drift-corrected" if drift is not None else "")),
        "x": (x, "px", "Place" + (", drift-corrected" if drift is not None else "")),
        "strength": (strength, "1", "Strength in units of the noise"),
    }
    return xr.Dataset(
        {name: ("detection", v, {"units": unit, "long_name": text}) for name, (v, unit, text) in values.items()},
        attrs=about | {"spacing_px": detector.spacing_px, "shape": [int(side) for side in about["shape"]]},
    )


def _filled(image: Reals, valid: Mask) -> Reals:
    """Return the image in units of :func:`unit_of`, with the median of its valid pixels where it is not valid."""
    unit = unit_of(image)
    image = image if unit == 1 else image / unit
    return image if valid.all() else np.where(valid, image, np.median(image[valid]))


def _image(source: ArrayLike) -> Reals:
    image = np.asarray(source)
    if image.ndim != 2 or image.dtype.kind not in "iuf":
        raise InputError(
            "columns cannot be detected in this",
            "source",
            "a movie, a summed image, or an image (y, x) of real numbers",
            f"an array of shape {image.shape}, {image.dtype}",
        )
    return image.astype(np.float64)


def _masked(image: Reals) -> tuple[Reals, Mask]:
    """Return an image, and where its pixels are numbers."""
    return image, np.isfinite(image)


def _rows(detector: Detector, image: Reals, valid: Mask, frame: int) -> Places:
    """Return what is found in an image as (n, 4) rows of frame, y, x, strength; none in an image without pixels."""
    if not valid.any():
        return np.empty((0, len(_FIELDS)))
    places, strength = detector(image, valid)
    return np.column_stack([np.full(len(places), frame), places[:, 1], places[:, 0], strength])


def _in_movie(
    movie: Movie,
    detector: Detector,
    shift: NDArray[np.float64],
    client: Client | None,
    on_event: Sink,
    folder: Path | None,
) -> Places:
    template = b"" if detector.template is None else detector.template.tobytes()
    with StageRun("detect", movie, on_event, folder, client, runs=1) as stage:
        key = stage_key("columns", movie.key, repr(detector), template, movie.shape)
        done = stage.journal("detections", key, {"found": ()})
        stage.begin([(done, movie.shards)])
        stage.run(partial(_detect_shard, movie, detector, done.path), movie.shards, done)
        found = np.concatenate([load_saved(done.path / f"{shard.index}.npy") for shard in movie.shards])
        found[:, 1:3] -= shift[found[:, 0].astype(np.int64)]
        stage.end(f"{len(found) / movie.n_frames:.1f} a frame")
    return found


def _detect_shard(movie: Movie, detector: Detector, folder: Path, shard: Shard) -> Payload:
    """Leave what is found in the frames of a shard in ``folder``; a layer of tiles is in memory at a time."""
    parts = []
    for start in range(shard.start, shard.stop, movie.layer_frames):
        frames = movie.read(start, min(start + movie.layer_frames, shard.stop))
        parts += [_rows(detector, *_masked(frame.astype(np.float64)), k) for k, frame in enumerate(frames, start)]
    save_array(folder / f"{shard.index}.npy", np.concatenate(parts))
    return {"found": sum(map(len, parts))}


def link_detections(
    detections: xr.Dataset,
    *,
    min_share: float = 0.1,
    radius_px: float | None = None,
    columns: xr.Dataset | None = None,
) -> xr.Dataset:
    """Return the columns that detections in many frames agree on, as seeds for :func:`tract_dask.find_columns`.

    Where detections are densest there is a column; those within the radius of it are its own. A column that is there
    in a part of the frames only, and faint or missing in the summed image, is found all the same.

    Parameters
    ----------
    detections
        From :func:`detect_columns` of a movie, drift-corrected.
    min_share
        Smallest share of the frames that a column is detected in.
    radius_px
        How far a column's detections scatter; unset: a sixth of the spacing.
    columns
        Columns that are known: they are returned with their IDs, and only others are added, with IDs above theirs.

    Returns
    -------
    Dataset
        :data:`schema.COLUMNS`, with ``share`` (column_id) of the frames with a detection (1 for those that were known),
        and ``first_frame``, ``last_frame`` of them (-1 for those that were known). With ``share``, ``find_columns``
        takes the amplitude in the summed image for that part of what it is while the column is there.

    Raises
    ------
    SettingsError
        Where the share or the radius is out of range.
    """
    radius = detections.attrs["spacing_px"] / 6 if radius_px is None else radius_px
    if not 0 < min_share <= 1 or not radius > 0:
        raise SettingsError(
            "the share or the radius is out of range",
            "link_detections",
            "min_share above 0, up to 1; radius_px above 0",
            f"{min_share:g}, {radius:g} px",
        )
    places = np.stack([detections["x"].to_numpy(), detections["y"].to_numpy()], axis=1)
    frame = detections["frame"].to_numpy()
    centres = _densest(places, radius) if len(places) else np.empty((0, 2))
    rows: list[tuple[float, ...]] = []
    if len(centres):
        _, own = cKDTree(centres).query(places, distance_upper_bound=radius)
        for k in range(len(centres)):
            frames = np.unique(frame[own == k])
            share = len(frames) / detections.attrs["n_frames"]
            if share >= min_share:
                rows.append((*places[own == k].mean(axis=0), share, frames[0], frames[-1]))
    known = column_dataset(np.empty((0, 2))) if columns is None else columns
    found = np.array(rows).reshape(-1, 5)
    if known.sizes["column_id"] and len(found):
        away, _ = cKDTree(positions(known)).query(found[:, :2])
        found = found[away > 2 * radius]
    return _with_seeds(known, found, columns is None)


def _densest(places: Places, radius: float) -> Places:
    """Return where places (x, y) are densest within a radius: maxima of their histogram, blurred to half of it."""
    step = radius / 4
    low = places.min(axis=0) - 2 * radius
    x, y = np.rint((places - low) / step).astype(np.int64).T
    histogram = np.zeros((y.max() + 9, x.max() + 9), np.float32)
    np.add.at(histogram, (y, x), 1.0)
    density = ndimage.gaussian_filter(histogram, 2.0)
    return np.asarray(local_maxima(density, radius / step, np.finfo(np.float32).tiny) * step + low)


def _with_seeds(known: xr.Dataset, found: Places, fresh: bool) -> xr.Dataset:
    """Return known columns and others, rows of x, y, share, first and last frame."""
    n, first = known.sizes["column_id"], int(known["column_id"].max()) + 1 if known.sizes["column_id"] else 1
    kinds = [*map(str, known["kind"].to_numpy()), *[""] * len(found)]
    ids = np.concatenate([known["column_id"].to_numpy(), np.arange(first, first + len(found))])
    seeds = column_dataset(np.concatenate([positions(known), found[:, :2]]), kinds, ids)
    seeds["share"] = "column_id", np.concatenate([np.ones(n), found[:, 2]])
    for k, name in enumerate(("first_frame", "last_frame"), 3):
        seeds[name] = "column_id", np.concatenate([np.full(n, -1), found[:, k]]).astype(np.int64)
    return seeds
