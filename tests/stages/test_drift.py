"""Drift against known truth, and sums against numpy."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from distributed import Client

from tract_dask.errors import SettingsError, SourceError
from tract_dask.progress import ShardDone, StageDone, StageStarted, Warned
from tract_dask.settings import DriftSettings
from tract_dask.stages.drift.measure import _middle
from tract_dask.stages.drift.stage import estimate_drift, read_drift_csv
from tract_dask.stages.sum import _accumulator, sum_image
from tract_dask.store.shards import split

PERIOD = 24.0
SHAPE = (140, 128)


@dataclass
class MemoryMovie:
    """What drift needs of a movie, held in memory."""

    pixels: np.ndarray[Any, Any]
    frames_per_shard: int = 1000
    bins: tuple[int, ...] = ()
    gain: float = 1.0
    offset: float = 0.0
    summed: int = 1
    pixel_size_pm: float | None = 10.0
    full_scale: float | None = None
    key: str = "key"
    path: Path = Path("memory")
    tile: tuple[int, int, int] = (16, 256, 256)
    reads: list[int] = field(default_factory=list)

    @property
    def shape(self):
        return self.pixels.shape

    @property
    def dtype(self):
        return self.pixels.dtype

    @property
    def n_frames(self):
        return len(self.pixels)

    @property
    def frame_bytes(self):
        return self.pixels[0].nbytes

    def statistics(self):
        flat = self.pixels.reshape(self.n_frames, -1).astype(float)
        missing = ~np.isfinite(flat)
        spread = [row[there].std() if there.any() else np.nan for row, there in zip(flat, ~missing, strict=True)]
        return xr.Dataset({"frame_std": ("t", spread), "frame_bad_pixels": ("t", missing.sum(axis=1))})

    @property
    def shards(self):
        return split(self.n_frames, self.frames_per_shard)

    def read(self, start, stop, y=slice(None), x=slice(None)):
        self.reads.append(stop - start)
        return self.pixels[start:stop, y, x].copy()

    def tiles(self, shard):
        depth, height, width = self.tile
        for start in range(shard.start, shard.stop, depth):
            for top, left in product(range(0, self.shape[1], height), range(0, self.shape[2], width)):
                stop = min(start + depth, shard.stop)
                yield start, top, left, self.pixels[start:stop, top : top + height, left : left + width].copy()

    def read_binned(self, factor, start, stop):
        ny, nx = self.shape[1:]
        edges = ((0, 0), (0, -ny % factor), (0, -nx % factor))
        padded = np.pad(self.pixels[start:stop].astype(np.float32), edges, mode="edge")
        tiles = padded.reshape(stop - start, padded.shape[1] // factor, factor, padded.shape[2] // factor, factor)
        return tiles.mean(axis=(2, 4), dtype=np.float32)


def lattice(shift, shape=SHAPE, period=PERIOD):
    """A lattice of round columns that fills the frame, between 0.7 and 1.7."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    waves = (np.cos(2 * np.pi * (u - s) / period) for u, s in ((y, shift[0]), (x, shift[1])))
    return 0.7 + np.exp(2.0 * sum(waves) - 4.0)


def counts(drift, dose, seed=0, shape=SHAPE):
    rng = np.random.default_rng(seed)
    return rng.poisson([dose * lattice(shift, shape) for shift in drift]).astype(np.uint8)


def walk(n, step, seed=1):
    drift = np.cumsum(np.random.default_rng(seed).normal(0, step, (n, 2)), axis=0)
    return drift - np.median(drift, axis=0)


def errors(found, truth):
    difference = found["drift"].to_numpy() - truth
    return difference - difference.mean(axis=0)


def position_bound(dose):
    """Cramer-Rao bound of one frame's shift by least squares, px; the same on both axes."""
    image = dose * lattice((0.0, 0.0))
    return float(np.sqrt(image.mean()) / np.sqrt((np.gradient(image)[0] ** 2).sum()))


@pytest.mark.parametrize(("dose", "frames_per_shard"), [(8.0, 100), (8.0, 7), (0.8, 10)])
def test_drift_reaches_the_bound(dose, frames_per_shard):
    truth = walk(40, 0.8)
    found = estimate_drift(MemoryMovie(counts(truth, dose), frames_per_shard))
    assert np.sqrt((errors(found, truth) ** 2).mean(axis=0)).max() <= 1.4 * position_bound(dose) + 0.01
    assert np.median(found["drift"], axis=0) == pytest.approx([0, 0], abs=1e-12)
    assert found["drift"].dims == ("frame", "axis")
    assert list(found["axis"].to_numpy()) == ["y", "x"]
    assert found.attrs["search_px"] == pytest.approx(0.4 * PERIOD, abs=0.8)
    assert found.attrs["pixel_size_pm"] == 10.0
    assert found["quality"].min() > 0.5


def test_long_drift_over_a_perfect_lattice_does_not_slip():
    """Three lattice vectors in all, in small steps, over a lattice without any mark; shards of one frame too."""
    truth = np.linspace((0, 0), (3 * PERIOD, -1.5 * PERIOD), 45)
    truth -= np.median(truth, axis=0)
    pixels = counts(truth, 6.0)
    for frames_per_shard in (45, 8, 1):
        found = estimate_drift(MemoryMovie(pixels, frames_per_shard))
        assert np.abs(errors(found, truth)).max() <= 6 * position_bound(6.0)


def test_a_jump_by_a_lattice_vector_is_not_drift():
    drift = np.zeros((12, 2))
    drift[6:, 0] = PERIOD
    found = estimate_drift(MemoryMovie(counts(drift, 6.0), 5))
    assert np.abs(found["drift"]).max() <= 6 * position_bound(6.0)


def test_a_search_range_admits_no_larger_step():
    drift = np.zeros((8, 2))
    drift[4:, 1] = 8.0
    pixels = counts(drift, 20.0)
    assert np.abs(errors(estimate_drift(MemoryMovie(pixels)), drift)).max() < 0.2
    held = estimate_drift(MemoryMovie(pixels), DriftSettings(search_px=3.0))
    assert np.ptp(held["drift"].to_numpy()) < 7.0
    assert held.attrs["search_px"] == 3.0


def test_a_static_faint_movie_does_not_slip():
    found = estimate_drift(MemoryMovie(counts(np.zeros((30, 2)), 0.3), 8))
    assert np.abs(found["drift"]).max() <= 6 * position_bound(0.3)


def test_large_frames_are_measured_on_a_binned_level(monkeypatch):
    monkeypatch.setattr("tract_dask.stages.drift.measure.LEVEL_PIXELS", 141 * 64)
    truth = walk(10, 1.5)
    pixels = counts(truth, 10.0, shape=(141, 130))
    movie = MemoryMovie(pixels, bins=(2, 8))
    found = estimate_drift(movie)
    assert found.attrs["bin"] == 2
    assert not movie.reads
    assert np.abs(errors(found, truth)).max() <= 6 * position_bound(10.0) + 0.02


def test_large_columns_are_binned_further():
    """Columns far larger than a pixel lose nothing by it: still at the full resolution's bound."""
    truth, dose = walk(10, 1.5), 2.0
    scene = np.array([dose * lattice(shift, (256, 260), 64.0) for shift in truth])
    found = estimate_drift(MemoryMovie(np.random.default_rng(9).poisson(scene).astype(np.uint8)))
    bound = np.sqrt(scene.mean()) / np.sqrt((np.gradient(scene[0])[0] ** 2).sum())
    assert found.attrs["bin"] > 1
    assert np.sqrt((errors(found, truth) ** 2).mean()) <= 1.5 * bound


def test_frames_without_information_are_bridged():
    truth = np.linspace((0, 0), (6, 3), 16)
    frames = counts(truth, 8.0).astype(np.float32)
    frames[0] = 0.0
    frames[5] = np.nan
    frames[9, :30, :40] = np.nan
    frames[10, 3, 4] = np.inf
    frames[12] = np.random.default_rng(5).poisson(6.0, SHAPE)  # beam on, no specimen
    found = estimate_drift(MemoryMovie(frames, 6))
    quality = found["quality"].to_numpy()
    assert quality[[0, 5]] == pytest.approx(0.0)
    assert (np.delete(quality, [0, 5, 12]) > 0.8).all()
    assert quality[12] < 0.3
    good = [k for k in range(16) if k not in (0, 5, 12)]
    away = found["drift"].to_numpy() - truth
    away -= away[good].mean(axis=0)
    assert np.abs(away[good]).max() <= 8 * position_bound(8.0)
    np.testing.assert_allclose(found["drift"][5], (found["drift"][4] + found["drift"][6]) / 2)
    assert np.isfinite(found["drift"]).all()


def test_a_movie_without_structure_has_no_drift():
    events: list[Any] = []
    found = estimate_drift(MemoryMovie(np.full((4, 64, 64), 7, np.uint8), 2), on_event=events.append)
    assert not found["drift"].any()
    assert not found["quality"].any()
    assert any(isinstance(event, Warned) for event in events)


def test_a_movie_of_one_frame():
    found = estimate_drift(MemoryMovie(counts(np.zeros((1, 2)), 8.0)))
    assert not found["drift"].any()
    assert found["quality"] > 0.9


class Stopped(Exception):
    """Raised to interrupt a stage."""


def stop_after(n):
    """An event sink that lets n parts through."""
    seen = []

    def sink(event):
        seen.append(isinstance(event, ShardDone))
        if sum(seen) == n:
            raise Stopped

    return sink


def test_resumed_and_distributed_runs_are_identical(tmp_path):
    """Fourteen frames make seven parts of two, each of which two runs go through."""
    movie = MemoryMovie(counts(walk(14, 1.0), 4.0), 3)
    whole = estimate_drift(movie, journal=tmp_path / "whole")
    for interrupted in (3, 9):
        folder = tmp_path / str(interrupted)
        with pytest.raises(Stopped):
            estimate_drift(movie, journal=folder, on_event=stop_after(interrupted))
        events: list[Any] = []
        xr.testing.assert_identical(whole, estimate_drift(movie, journal=folder, on_event=events.append))
        assert events[0] == StageStarted("drift", 28, 2 * interrupted, 0, SHAPE[0] * SHAPE[1], 2)
        assert sum(isinstance(event, ShardDone) for event in events) == 14 - interrupted
    with Client(processes=False, n_workers=2, threads_per_worker=1, dashboard_address=None) as client:
        xr.testing.assert_identical(whole, estimate_drift(movie, client=client))
    estimate_drift(movie, journal=tmp_path / "whole", on_event=events.append)
    assert isinstance(events[-1], StageDone)
    assert events[-1].reused


def test_other_settings_start_anew(tmp_path):
    movie = MemoryMovie(counts(np.zeros((4, 2)), 8.0))
    estimate_drift(movie, journal=tmp_path)
    events: list[Any] = []
    estimate_drift(movie, DriftSettings(search_px=4.0), journal=tmp_path, on_event=events.append)
    assert events[0].done_frames == 0


def test_method_none():
    found = estimate_drift(MemoryMovie(np.zeros((3, 8, 8), np.uint8)), DriftSettings(method="none"))
    assert not found["drift"].any()
    assert (found["quality"] == 1).all()


def test_method_csv(tmp_path):
    path = tmp_path / "drift.csv"
    path.write_text("frame, x, y, note\n1,2.5,-1,b\n0,0,0.5,a\n2,1e1,3,c\n")
    found = estimate_drift(
        MemoryMovie(np.zeros((3, 8, 8), np.uint8)), DriftSettings(method="csv", csv=str(path)), journal=tmp_path
    )
    np.testing.assert_array_equal(found["drift"], [[0.5, 0], [-1, 2.5], [3, 10]])
    assert found.attrs["method"] == "csv"


def test_method_csv_needs_a_file():
    with pytest.raises(SettingsError, match="needs a file"):
        estimate_drift(MemoryMovie(np.zeros((3, 8, 8), np.uint8)), DriftSettings(method="csv"))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frame,y\n0,1\n", r"line 1: column 'x' is missing.*frame, y\."),
        ("", r"line 1: column 'frame' is missing.*empty file"),
        ("frame,y,x\n0,1,1\n1,one,1\n", r"line 3: this is not a number.*'one'"),
        ("frame,y,x\n0,1\n", r"line 2: there are fewer values than"),
        ("frame,y,x\n0,1,5,2,5\n", r"line 2: there are more values.*3 values: frame, y, x"),
        ("frame,y,x\n0,1,nan\n", r"line 2: the drift is not finite"),
        ("frame,y,x\n0,1,1\n2,1,1\n", r"line 3: there is no such frame. Expected 0 to 1; got 2"),
        ("frame,y,x\n0.5,1,1\n", r"line 2: there is no such frame"),
        ("frame,y,x\n0,1,1\n0,1,1\n", r"line 3: frame 0 occurs twice.*line 2"),
        ("frame,y,x\n1,1,1\n", r"frames are missing.*the first one missing is 0"),
    ],
)
def test_unusable_csv_files_are_explained(tmp_path, text, message):
    path = tmp_path / "drift.csv"
    path.write_text(text)
    with pytest.raises(SourceError, match=message):
        read_drift_csv(path, 2)


def test_missing_and_binary_csv_files(tmp_path):
    with pytest.raises(SourceError, match="cannot be read"):
        read_drift_csv(tmp_path / "none.csv", 2)
    (tmp_path / "drift.csv").write_bytes(b"frame,y,x\n\xff\xfe\x00")
    with pytest.raises(SourceError, match="cannot be read"):
        read_drift_csv(tmp_path / "drift.csv", 2)


def drift_dataset(drift, quality=None):
    quality = np.ones(len(drift)) if quality is None else quality
    return xr.Dataset({"drift": (("frame", "axis"), np.asarray(drift, float)), "quality": ("frame", quality)})


def direct_sum(pixels, drift, used=None):
    """The definition, pixel by pixel."""
    n, ny, nx = pixels.shape
    total, exposure = np.zeros((ny, nx)), np.zeros((ny, nx), int)
    for k in range(n) if used is None else np.flatnonzero(used):
        dy, dx = np.rint(drift[k]).astype(int)
        for y in range(max(0, -dy), min(ny, ny - dy)):
            for x in range(max(0, -dx), min(nx, nx - dx)):
                value = pixels[k, y + dy, x + dx]
                if np.isfinite(value):
                    total[y, x] += value
                    exposure[y, x] += 1
    return np.divide(total, exposure, out=np.zeros((ny, nx)), where=exposure > 0), exposure


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "float32"])
@pytest.mark.parametrize("tile", [(2, 32, 32), (1, 4, 5)])
def test_sum_is_the_mean_of_the_moved_frames(dtype, tile):
    rng = np.random.default_rng(6)
    pixels = rng.integers(0, 200, (40, 17, 13)).astype(dtype)
    drift = rng.uniform(-6, 6, (40, 2))
    drift[3] = 30, 0  # wholly outside
    found = sum_image(MemoryMovie(pixels, 2, gain=0.5, tile=tile), drift_dataset(drift))
    image, exposure = direct_sum(pixels, drift)
    np.testing.assert_array_equal(found["exposure"], exposure)
    np.testing.assert_array_equal(found["image"], 0.5 * image)
    assert found["exposure"].dtype == np.uint32
    np.testing.assert_allclose(found.attrs["rounding_px"], (drift - np.rint(drift)).mean(axis=0))
    assert found.attrs["n_frames"] == 40


def test_sum_leaves_out_what_is_bad():
    rng = np.random.default_rng(7)
    pixels = rng.integers(0, 9, (6, 10, 12)).astype(np.float32)
    pixels[1, 2, 3], pixels[2, :, :4], pixels[4] = np.nan, np.inf, np.nan
    drift = rng.integers(-2, 3, (6, 2)).astype(float)
    quality = np.array([1, 1, 1, 0, 1, 1.0])
    found = sum_image(MemoryMovie(pixels, 4), drift_dataset(drift, quality))
    image, exposure = direct_sum(pixels, drift, quality > 0)
    np.testing.assert_array_equal(found["exposure"], exposure)
    np.testing.assert_allclose(found["image"], image, rtol=1e-15)


def test_pixels_that_are_never_exposed_are_zero():
    found = sum_image(MemoryMovie(np.ones((2, 6, 6), np.uint8)), drift_dataset([[2, 0], [3, 0]]))
    assert not found["image"][4:].any()
    assert not found["exposure"][4:].any()
    assert (found["exposure"][:3] == 2).all()


def test_sum_is_the_same_by_any_way(tmp_path):
    rng = np.random.default_rng(8)
    movie = MemoryMovie(rng.normal(size=(35, 20, 20)).astype(np.float32), 2)
    drift = drift_dataset(rng.uniform(-2, 2, (35, 2)))
    whole = sum_image(movie, drift)
    with pytest.raises(Stopped):
        sum_image(movie, drift, journal=tmp_path, on_event=stop_after(7))
    events: list[Any] = []
    xr.testing.assert_identical(whole, sum_image(movie, drift, journal=tmp_path, on_event=events.append))
    assert isinstance(events[0], StageStarted)
    assert events[0].done_frames == 7 * 4
    assert [event.frames for event in events if isinstance(event, ShardDone)] == [4, 3]
    with Client(processes=False, n_workers=2, threads_per_worker=1, dashboard_address=None) as client:
        xr.testing.assert_identical(whole, sum_image(movie, drift, client=client))


def test_sum_without_drift():
    pixels = np.arange(2 * 5 * 5, dtype=np.uint16).reshape(2, 5, 5)
    np.testing.assert_array_equal(sum_image(MemoryMovie(pixels))["image"], pixels.mean(axis=0))


def test_sum_refuses_the_drift_of_another_movie():
    with pytest.raises(SettingsError, match="another movie"):
        sum_image(MemoryMovie(np.ones((3, 4, 4), np.uint8)), drift_dataset([[0, 0]]))


def test_sums_of_integers_are_exact():
    assert _accumulator(MemoryMovie(np.zeros((1, 1, 1), np.uint16)), 60_000) == np.uint32
    assert _accumulator(MemoryMovie(np.zeros((1, 1, 1), np.uint16)), 70_000) == np.uint64
    assert _accumulator(MemoryMovie(np.zeros((1, 1, 1), np.int8)), 10) == np.int64
    pixels = np.full((300, 3, 3), 65535, np.uint16)
    assert (sum_image(MemoryMovie(pixels, 10))["image"] == 65535).all()


@pytest.mark.parametrize("count", [1, 2, 7, 50])
def test_the_usual_score_is_the_median_of_all(count):
    scores = np.random.default_rng(count).normal(size=count)
    assert _middle(sorted(scores.tolist())) == np.median(scores)
    assert np.isnan(_middle([]))


def marked(drift, edge=0.0, dose=8.0):
    """A lattice, with vacuum above ``edge`` of the frame, that moves by ``drift``."""
    chance, frames = np.random.default_rng(2), []
    y = np.arange(SHAPE[0])[:, None]
    for shift in drift:
        image = lattice(shift)
        frames.append(chance.poisson(dose * np.where(y < edge + shift[0], 0.5, image)))
    return np.array(frames).astype(np.uint8)


@pytest.mark.parametrize("step", [0.4, 0.6, 0.9, 1.2])
@pytest.mark.parametrize("frames_per_shard", [24, 4])
def test_an_edge_tells_a_step_that_is_longer_than_the_search(step, frames_per_shard):
    truth = 0.2 * walk(24, 0.8)
    truth[9:] += step * PERIOD * np.array([0.9, 0.3])
    events = []
    found = estimate_drift(MemoryMovie(marked(truth, 55.0), frames_per_shard), on_event=events.append)
    assert np.abs(errors(found, truth)).max() < 1.0
    told = [event for event in events if isinstance(event, Warned)]
    assert bool(told) == (step > 0.8)  # along the edge it may then be a period shorter


def test_a_step_that_nothing_tells_from_one_a_period_off_is_named():
    truth = np.zeros((20, 2))
    truth[12:, 0] = 0.45 * PERIOD
    events = []
    found = estimate_drift(MemoryMovie(marked(truth)), on_event=events.append)
    told = [event.message for event in events if isinstance(event, Warned)]
    assert found.attrs["doubtful"] == [12]
    assert len(told) == 1
    assert "frame 12 " in told[0]
