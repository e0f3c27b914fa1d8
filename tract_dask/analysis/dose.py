"""A movie at other doses a frame: sums of its frames, made when they are read, and its columns fitted in them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, fields
from functools import partial
from itertools import product
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..errors import SettingsError
from ..kernels.gaussian import parameters
from ..kernels.gaussian.parameters import AMPLITUDE, BACKGROUND
from ..kernels.sums import add_tiles
from ..kernels.windows import Tiles
from ..settings.run import FitSettings
from ..stages.fit.lazy import fit_columns
from ..store import schema
from ..store.keys import digest_of
from ..store.movie import Frames, Movie
from ..store.shard_files import overlaps
from ..store.shards import Shard

_EVERYTHING = slice(None)


def rebin_frames(movie: Movie, n: int, drift: xr.Dataset | None = None) -> SummedFrames:
    """Return the movie whose frames are sums of ``n`` consecutive ones; they are summed when they are read.

    So precision and intensity can be studied against the dose of a frame, from one movie. Whatever takes a movie takes
    this one.

    Parameters
    ----------
    movie
        An opened movie.
    n
        Frames in a sum. The last ``movie.n_frames % n`` frames, too few for a sum, are left out.
    drift
        From :func:`tract_dask.estimate_drift`. Frames of one sum are then laid on one another by the whole-pixel part
        of what their drift differs from its mean over the sum; no pixel is resampled. What rounding leaves blurs
        columns by at most 0.29 px (standard deviation). Pixels beyond a frame's edge are taken to be like those on
        it. None: frames are summed as they are.

    Returns
    -------
    SummedFrames
        Its attribute ``drift`` is what :func:`tract_dask.fit_columns` needs for it.

    Raises
    ------
    SettingsError
        Where ``n`` is not between 1 and the number of frames, or the drift is of another movie.

    Examples
    --------
    ``pairs = rebin_frames(movie, 2, drift)``; then ``fit_columns(pairs, columns, pairs.drift)`` with columns that were
    found in a sum of ``pairs``, or :func:`fit_doses`, which takes those of the movie.
    """
    if not 1 <= n <= movie.n_frames:
        raise SettingsError(
            "the sum is out of range", "rebin_frames: n", f"1 to {movie.n_frames} frames in a sum", f"{n}"
        )
    n_sums = movie.n_frames // n
    measured = schema.drift_of(drift, movie.n_frames)[: n_sums * n].reshape(n_sums, n, 2)
    shift = np.rint(measured - measured.mean(axis=1, keepdims=True)).astype(np.int64)
    return SummedFrames(
        path=movie.path,
        shape=(n_sums, *movie.shape[1:]),
        dtype=_dtype_of_sum(movie.dtype, n),
        key=digest_of(movie.key, f"sums of {n}", shift),
        frames_per_shard=min(n_sums, max(1, movie.frames_per_shard // n)),
        bins=(),
        pixel_size_pm=movie.pixel_size_pm,
        frame_time_s=None if movie.frame_time_s is None else n * movie.frame_time_s,
        dose=None if movie.dose is None else n * movie.dose,
        gain=movie.gain,
        offset=n * movie.offset,
        source=movie,
        n=n,
        shift=shift.reshape(-1, 2),
        drift=None if drift is None else _drift_of_sums(drift, measured - shift),
    )


@dataclass(frozen=True, kw_only=True)
class SummedFrames(Movie):
    """Sums of consecutive frames of a movie, made by :func:`rebin_frames`; a movie without binned levels.

    No more of the source is in memory than the tiles of one of its shards that are asked for.

    Attributes
    ----------
    source
        The movie whose frames are summed.
    n
        Frames in a sum.
    shift
        (n * n_frames, 2) how far the frames of the source are moved before they are summed, (y, x), whole pixels.
    drift
        Drift of the sums (:data:`schema.DRIFT`): the mean of what moving leaves of their frames'; None where no drift
        was given.
    """

    source: Movie
    n: int
    shift: NDArray[np.int64] = field(compare=False, repr=False)
    drift: xr.Dataset | None = field(compare=False, repr=False)

    @property
    def summed(self) -> int:
        """Frames of the camera in a frame of this movie."""
        return self.n * self.source.summed

    def __reduce__(self) -> tuple[Callable[..., Movie], tuple[Any, ...]]:
        return partial(SummedFrames, **{item.name: getattr(self, item.name) for item in fields(self)}), ()

    @property
    def full_scale(self) -> None:
        """None: a sum in which a frame is saturated is infinite, and has no limit that is known."""
        return

    @property
    def n_dropped(self) -> int:
        """Number of frames at the end of the source that are in no sum."""
        return self.source.n_frames - self.n * self.n_frames

    @property
    def layer_frames(self) -> int:
        """Frames that are best read together: the sums that a layer of the source's tiles holds."""
        return max(1, self.source.layer_frames // self.n)

    def times(self) -> NDArray[np.float64]:
        """Return the start of each sum (frames,) in s; its number where the frame time is not known."""
        if self.frame_time_s is None:
            return np.arange(self.n_frames, dtype=np.float64)
        return self.source.times()[: self.n * self.n_frames : self.n]

    def frame_values(self) -> dict[str, xr.Variable]:
        """Return what the headers of the frames say, by name: means over the frames of each sum."""
        return {
            name: xr.Variable("frame", of.values[: self.shift.shape[0]].reshape(-1, self.n).mean(axis=1), of.attrs)
            for name, of in self.source.frame_values().items()
        }

    def read(self, start: int, stop: int, y: slice = _EVERYTHING, x: slice = _EVERYTHING) -> Frames:
        """Return the sums ``start`` to ``stop`` (not included), or a part of their field; (frames, y, x)."""
        y, x = (slice(*span.indices(length)[:2]) for span, length in zip((y, x), self.shape[1:], strict=True))
        start, stop, _ = slice(start, stop).indices(self.n_frames)
        part = np.empty((max(0, stop - start), max(0, y.stop - y.start), max(0, x.stop - x.start)), self.dtype)
        if part.size:
            tiles = self.read_tiles(start, stop, np.array([[y.start, x.start, y.stop, x.stop]]))
            height, width = tiles.pixels.shape[2:]
            for (row, y_in, y_out), (column, x_in, x_out) in product(overlaps(y, height), overlaps(x, width)):
                part[:, y_out, x_out] = tiles.pixels[tiles.place[row, column], :, y_in, x_in]
        return part

    def read_tiles(self, start: int, stop: int, boxes: NDArray[np.int64]) -> Tiles:
        """Return the tiles of the sums ``start`` to ``stop`` (not included) that boxes touch, as a movie does.

        ``start`` and ``stop`` may be anywhere. The source is read a layer of its tiles at a time.
        """
        reach = np.abs(self.shift[start * self.n : stop * self.n]).max(initial=0)
        wide = boxes + reach * np.array([-1, -1, 1, 1])
        total = np.empty((0, 0, 0, 0), self.dtype)
        for begin, first, last in self._layers(start * self.n, stop * self.n):
            tiles = self.source.read_tiles(begin, last, wide)
            if first == start * self.n:
                total = np.zeros((len(tiles.pixels), stop - start, *tiles.pixels.shape[2:]), self.dtype)
            pixels = tiles.pixels[:, first - begin : last - begin]
            pixels = pixels.astype(np.float32) if pixels.dtype == np.float16 else pixels  # which compiled code cannot
            belongs = np.arange(first, last) // self.n - start
            add_tiles(total, pixels, tiles.place, self.shape[1:], belongs, self.shift[first:last])
        return Tiles(total, tiles.place, self.shape[1:])

    def tiles(self, shard: Shard) -> Iterator[tuple[int, int, int, Frames]]:
        """Yield the tiles of a shard of the sums: first frame, row and column, and pixels (frames, y, x)."""
        rows, columns = self.shape[1:]
        whole = self.read_tiles(shard.start, shard.stop, np.array([[0, 0, rows, columns]]))
        height, width = whole.pixels.shape[2:]
        for (row, column), number in np.ndenumerate(whole.place):
            top, left = row * height, column * width
            yield shard.start, top, left, whole.pixels[number, :, : rows - top, : columns - left]

    def statistics(self) -> xr.Dataset:
        """Return what the source's statistics tell of the sums without reading them, on ``t``, in memory.

        They are sums of the frames': so no pixel is smaller than ``frame_min`` or larger than ``frame_max``, but there
        need not be one of that value. ``frame_bad_pixels`` is that of the worst frame. There is no ``frame_std``.
        """
        frames = self.source.statistics().isel(t=slice(self.n * self.n_frames))
        sums = {
            name: ("t", frames[name].to_numpy().reshape(-1, self.n).sum(axis=1), frames[name].attrs)
            for name in ("frame_min", "frame_max", "frame_mean")
        }
        missing = frames["frame_bad_pixels"]
        sums["frame_bad_pixels"] = ("t", missing.to_numpy().reshape(-1, self.n).max(axis=1), missing.attrs)
        return xr.Dataset(sums, {"t": frames["t"][:: self.n]})

    @property
    def frames(self) -> xr.DataArray:
        """The sums as a lazy array (t, y, x) with coordinates, one Dask chunk a shard."""
        import dask.array as da  # takes its time, and workers do not need it

        shards = {shard.index: shard for shard in self.shards}

        def read(index: NDArray[np.int64]) -> Frames:
            shard = shards[int(index[0])]
            return self.read(shard.start, shard.stop)

        pixels = da.map_blocks(
            read,
            da.arange(len(shards), chunks=1),
            new_axis=[1, 2],
            chunks=(tuple(shard.frames for shard in self.shards), *self.shape[1:]),
            dtype=self.dtype,
            name=f"movie-{self.key}",
            meta=np.empty((0, 0, 0), self.dtype),
        )
        known = {name: getattr(self, name) for name in schema.CALIBRATION}
        attributes = {name: value for name, value in known.items() if value is not None}
        source = self.source.frames
        coordinates = {"t": source["t"][: self.n * self.n_frames : self.n], "y": source["y"], "x": source["x"]}
        return xr.DataArray(pixels, coordinates, source.dims, "movie", attributes)

    def _layers(self, start: int, stop: int) -> Iterator[tuple[int, int, int]]:
        """Yield, for the layers of the source that a span of frames touches, their first frame and the part touched."""
        first = start
        while first < stop:
            shard = first // self.source.frames_per_shard * self.source.frames_per_shard
            begin = first - (first - shard) % self.source.layer_frames
            last = min(begin + self.source.layer_frames, shard + self.source.frames_per_shard, stop)
            yield begin, first, last
            first = last


def fit_doses(
    movie: Movie,
    columns: xr.Dataset,
    drift: xr.Dataset | None = None,
    groups: Sequence[int] = (1, 2, 4),
    settings: FitSettings | None = None,
    *,
    summed: xr.Dataset | None = None,
) -> list[xr.Dataset]:
    """Fit every column of one movie at several doses a frame, lazily: in sums of 1, 2, 4 … frames.

    Parameters
    ----------
    groups
        Frames in a sum, one number for each Dataset.
    movie, columns, drift, settings, summed
        As :func:`tract_dask.fit_columns` takes them for the movie itself.

    Returns
    -------
    list of xr.Dataset
        Tracks as :func:`tract_dask.fit_columns` returns them. Their attribute ``dose`` is that of a sum, where the
        movie's is known. :func:`tract_dask.analysis.precision.precision_table` and
        :func:`tract_dask.analysis.intensity.intensity_against_dose` take the list.

    Raises
    ------
    SettingsError
        As :func:`rebin_frames` and :func:`tract_dask.fit_columns`.
    """
    tracks = []
    for n in groups:
        sums = rebin_frames(movie, n, drift)
        brighter = None if summed is None else summed.assign(image=n * summed["image"])
        tracks.append(fit_columns(sums, _brighter(columns, n), sums.drift, settings, summed=brighter))
    return tracks


def _brighter(columns: xr.Dataset, n: int) -> xr.Dataset:
    """Return the columns as they are in sums of ``n`` frames: amplitude and background in counts of a sum."""
    factor = np.ones(len(parameters.PARAMETERS))
    factor[[AMPLITUDE, BACKGROUND]] = n
    return columns.assign(fit_ref=(columns["fit_ref"].dims, columns["fit_ref"].to_numpy() * factor))


def _dtype_of_sum(dtype: np.dtype[Any], n: int) -> np.dtype[Any]:
    """Return the smallest integers that hold every sum of ``n`` pixels; real pixels keep theirs, of 32 bits or more.

    Examples
    --------
    >>> [str(_dtype_of_sum(np.dtype(name), 40)) for name in ("uint8", "uint16", "int16", "float32")]
    ['uint16', 'uint32', 'int32', 'float32']
    """
    if dtype.kind == "f":
        return np.promote_types(dtype, np.float32)
    limits = np.iinfo(dtype)
    return np.min_scalar_type(n * limits.min if limits.min else min(n * limits.max, np.iinfo(np.uint64).max))


def _drift_of_sums(drift: xr.Dataset, left: NDArray[np.float64]) -> xr.Dataset:
    """Return the drift of sums, given what is left of that of their frames, (sums, n, axis)."""
    quality = drift["quality"].to_numpy()[: left.shape[0] * left.shape[1]].reshape(left.shape[:2])
    values = {"drift": left.mean(axis=1), "quality": quality.min(axis=1)}
    return xr.Dataset(
        {name: (schema.DRIFT[name].dims, value, schema.DRIFT[name].attributes) for name, value in values.items()},
        {"frame": np.arange(len(left)), "axis": ("axis", schema.texts(schema.AXES))},
    )
