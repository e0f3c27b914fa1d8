"""What is measured of a camera, against simulated cameras of which all is known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from scipy.ndimage import gaussian_filter

from tract_dask import sum_image
from tract_dask.errors import InputError
from tract_dask.kernels.noise import Cells, fit_law
from tract_dask.report.camera import camera_findings, fine_columns, pattern_words
from tract_dask.stages.noise import _pattern, measure_camera
from tract_dask.stages.sum import _measured
from tract_dask.store.camera import NOT_MEASURED, Camera

SHAPE = (192, 192)


class Recorded(SimpleNamespace):
    """What a measurement needs of a movie, in memory."""

    summed = 1

    def read(self, start, stop, y, x):
        return self.pixels[start:stop, y, x]

    @property
    def shape(self):
        return self.pixels.shape

    @property
    def n_frames(self):
        return len(self.pixels)


def frames_of(n=40, shape=SHAPE, electrons=8.0, contrast=1.0, moving=0.0, seed=3, sigma=3.5):
    """Return counted electrons (n, y, x) of columns below a vacuum, drifting; the drift; and a random generator."""
    rng = np.random.default_rng(seed)
    y, x = np.arange(shape[0]), np.arange(shape[1])
    place = np.array(
        [(v, u) for v in np.arange(shape[0] / 3, shape[0] + 24, 24) for u in np.arange(0, shape[1] + 24, 24)]
    )
    drift = np.cumsum(rng.normal(0, 0.3, (n, 2)), axis=0)
    drift -= np.median(drift, axis=0)
    counts = np.empty((n, *shape), np.float32)
    for frame, shift in zip(counts, drift, strict=True):
        at = place + shift + rng.normal(0, moving, place.shape)
        down, across = (
            np.exp(-((axis - own[:, None]) ** 2) / 2 / sigma**2) for axis, own in ((y, at[:, 0]), (x, at[:, 1]))
        )
        frame[...] = rng.poisson(electrons * (1 + contrast * np.einsum("cy,cx->yx", down, across)))
    return counts, drift, rng


def measured(pixels, drift, offset=0.0):
    shift = np.rint(drift).astype(int)
    total, seen = np.zeros(pixels.shape[1:]), np.zeros(pixels.shape[1:])
    for frame, (dy, dx) in zip(pixels, shift, strict=True):
        moved = np.roll(frame.astype(float), (-dy, -dx), (0, 1))
        total, seen = total + moved, seen + 1
    edge = int(np.abs(shift).max()) + 1
    covered = np.zeros(total.shape, bool)
    covered[edge:-edge, edge:-edge] = True
    movie = Recorded(pixels=pixels, offset=offset)
    return measure_camera(movie, total / seen, covered, drift, np.ones(len(pixels), bool))


@pytest.mark.parametrize(
    ("gain", "offset", "read", "dtype"),
    [
        (1.0, 0.0, 0.0, np.uint16),
        (7.3, 100.0, 5.0, np.uint16),  # a CMOS camera
        (0.4, 0.0, 0.0, np.float32),
        (0.02, 0.0, 0.0, np.float32),  # normalised frames
    ],
)
def test_gain_and_offset_are_those_of_the_camera(gain, offset, read, dtype):
    """Within 8 % and, for the level without noise, 8 % of the usual level above it."""
    counts, drift, rng = frames_of()
    pixels = gain * counts + offset + read * rng.normal(size=counts.shape)
    camera = measured((np.rint(pixels) if dtype == np.uint16 else pixels).astype(dtype), drift, offset)
    assert camera.per_electron == pytest.approx(gain, rel=0.08)
    assert camera.zero == pytest.approx(offset - read**2 / gain, abs=0.08 * gain * 10)
    assert camera.correlation == ((1.0,),)
    assert not [found for found in camera_findings(camera, 1 / gain, offset, offset + 10 * gain) if "remedy" in found]


@pytest.mark.parametrize(
    ("sigma", "electrons", "contrast"),
    [(0.8, 20.0, 1.0), (1.1, 60.0, 1.0), (2.0, 100.0, 3.0), (2.0, 1000.0, 3.0), (3.0, 100.0, 3.0)],
)
def test_sharp_or_bright_columns_that_drift_over_the_pixels_are_no_noise(sigma, electrons, contrast):
    """The gain is right within 10 %, or not known; with their motion it was up to 2.3 times too large."""
    counts, drift, _ = frames_of(n=14, shape=(128, 128), electrons=electrons, contrast=contrast, sigma=sigma)
    camera = measured(counts, drift)
    assert camera.per_electron is None or camera.per_electron == pytest.approx(1, abs=0.1)
    assert not [found for found in camera_findings(camera, 1.0, 0.0, electrons) if "remedy" in found]


@pytest.mark.parametrize("seed", [4, 6])
def test_the_gain_of_a_camera_that_spreads_electrons_is_that_of_electrons(seed):
    """Within 8 %: the variance of a pixel is less blurred than its mean, which made the gain up to 15 % too large."""
    counts, drift, _ = frames_of(seed=seed)
    camera = measured(np.stack([gaussian_filter(frame, 2.0) for frame in counts]).astype(np.float32), drift)
    assert camera.per_electron == pytest.approx(1, abs=0.08)


def test_read_noise_is_told_from_an_offset_where_counts_are_few():
    counts, drift, rng = frames_of(n=120, electrons=0.5, contrast=6.0)
    camera = measured((counts * 10 + 50 + 6 * rng.normal(size=counts.shape)).astype(np.float32), drift)
    assert camera.offset == pytest.approx(50, abs=1.5)
    assert camera.read_noise == pytest.approx(6, rel=0.15)


def test_wide_columns_that_move_by_themselves_share_no_noise():
    """Half a pixel of jitter: 0.3 % of correlation over the whole width of the columns was a fifth of the noise."""
    counts, drift, _ = frames_of(electrons=8.0, contrast=3.0, sigma=5.0, moving=0.5)
    camera = measured(counts, drift)
    assert camera.shared.shape == (1, 1)
    assert camera.per_electron == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize(("moving", "share"), [(0.25, 0.1), (0.5, 0.25)])
def test_columns_that_move_are_neither_gain_nor_shared_noise(moving, share):
    """A quarter and half a pixel of jitter of every column; at 100 electrons half a pixel is as much as the noise."""
    counts, drift, _ = frames_of(electrons=100.0, moving=moving)
    camera = measured(counts, drift)
    assert camera.per_electron == pytest.approx(1, rel=share)
    assert Camera.of(camera.to_attribute()).shared.sum() == pytest.approx(1, abs=0.05)
    assert not list(camera_findings(camera, 1.0, 0.0, 120.0))


@pytest.mark.parametrize(("n", "side"), [(2, 192), (10, 192), (40, 24)])
def test_short_and_small_movies_say_that_nothing_is_measured(n, side):
    counts, drift, _ = frames_of(n=n, shape=(side, side))
    camera = measured(counts, drift)
    assert camera.per_electron is None
    (found,) = camera_findings(camera, 1.0, 0.0, 8.0)
    assert not found["serious"]
    assert "12 frames of 32 px" in found["text"]


def test_a_field_of_one_level_tells_no_gain():
    counts, drift, _ = frames_of(contrast=0.0)
    camera = measured(counts, drift)
    assert camera.per_electron is None
    assert camera.reason


def test_a_line_through_cells_is_found_whatever_moves():
    rng = np.random.default_rng(0)
    level, slope, number = rng.uniform(10, 30, 64), rng.uniform(0, 4, 64), np.full(64, 2e4)
    variance = (2 * (level - 4) + 0.3 * slope) * (1 + rng.normal(0, 0.01, 64))
    law = fit_law(Cells(level, slope, variance, np.zeros(64), number))
    assert law.per_count == pytest.approx(2, rel=0.02)
    assert law.zero == pytest.approx(4, abs=0.3)
    assert law.motion == pytest.approx(0.3, rel=0.3)


@pytest.mark.parametrize(
    ("gain", "offset", "titles"),
    [
        (1 / 7.3, 100.0, []),
        (1.0, 100.0, ["The gain is not what was said"]),
        (1 / 7.3, 0.0, ["The offset is not what was said"]),
        (1.0, 0.0, ["The gain is not what was said", "The offset is not what was said"]),
    ],
)
def test_what_differs_from_what_was_said_is_a_warning_with_a_remedy(gain, offset, titles):
    camera = Camera(per_electron=7.3, per_electron_stderr=0.1, zero=96.6, zero_stderr=0.8, noise_per_count=7.3)
    found = list(camera_findings(camera, gain, offset, 150.0))
    assert [one["title"] for one in found] == titles
    assert all("auto" in one["remedy"] for one in found)


@pytest.mark.parametrize(("offset", "told"), [(-1.0, True), (-0.3, False), (None, False)])
def test_a_dark_image_that_was_subtracted_twice_is_told_where_read_noise_is_known(offset, told):
    """Level 2.2 above it: 1 is a third of the noise, which may be read noise unless the third moment says otherwise."""
    camera = Camera(per_electron=1.0, per_electron_stderr=0.01, zero=-1.0, zero_stderr=0.05, offset=offset)
    found = list(camera_findings(camera, 1.0, 0.0, 2.2, dark=True))
    assert [one["title"] for one in found] == ["The offset is not what was said"] * told
    assert all("without --dark" in one["remedy"] and "subtracted again" in one["text"] for one in found)


def test_a_camera_goes_through_its_attribute_and_to_sums():
    camera = Camera(per_electron=7.0, zero=90.0, zero_stderr=1.0, offset=95.0, read_noise=3.0, correlation=((1.0,),))
    assert Camera.of(camera.to_attribute()) == camera
    assert Camera.of({}) is NOT_MEASURED
    sums = camera.of_sums(4)
    assert (sums.per_electron, sums.zero, sums.offset, sums.read_noise, sums.frames) == (7.0, 360.0, 380.0, 6.0, 4)


def test_the_sum_is_above_the_offset_and_names_the_camera(tmp_path):
    from tract_dask import convert, open_movie
    from tract_dask.settings import MetadataSettings

    counts, _, _ = frames_of(n=14, shape=(64, 64))
    np.save(tmp_path / "movie.npy", (2 * counts + 30).astype(np.uint16))
    known = MetadataSettings(gain=0.5, offset=30.0)
    movie = open_movie(convert(tmp_path / "movie.npy", tmp_path / "movie.zarr", metadata=known))
    summed = sum_image(movie)
    np.testing.assert_allclose(summed["image"], counts.mean(axis=0), rtol=1e-6)
    assert Camera.of(summed.attrs) is not NOT_MEASURED


@pytest.mark.parametrize(
    ("wanted", "offset", "shared", "known"),
    [
        (("gain",), 0.0, 3.0, False),  # 96.6 counts without noise, and no offset said
        (("gain", "offset"), 0.0, 3.0, False),
        (("gain",), 100.0, 3.0, True),
        (("gain", "offset"), 0.0, 1.0, True),
        (("offset",), 0.0, 3.0, True),
    ],
)
def test_a_gain_that_read_noise_may_have_spoilt_is_refused(wanted, offset, shared, known):
    ring = [(shared - 1) / 8] * 4
    correlation = None if shared == 1 else ((*ring[:3],), (ring[0], 1.0, ring[0]), (*ring[:3],))
    camera = Camera(per_electron=3.2, per_electron_stderr=0.1, zero=96.6, zero_stderr=0.5, correlation=correlation)
    movie = SimpleNamespace(to_measure=wanted, offset=offset, gain=1.0, path="movie.zarr", n_frames=40)
    summed = SimpleNamespace(attrs=camera.to_attribute())
    if known:
        assert _measured(movie, summed)[0] == (1 / 3.2 if "gain" in wanted else 1.0)
    else:
        with pytest.raises(InputError, match="share their electrons"):
            _measured(movie, summed)


def test_a_hot_pixel_leaves_no_hole_in_the_sum_whose_offset_is_measured(tmp_path):
    from tract_dask import convert, open_movie
    from tract_dask.settings import MetadataSettings
    from tract_dask.stages.sum import sum_stage

    counts, _, _ = frames_of(n=24, moving=0.0)
    pixels = (5 * counts + 100).astype(np.uint16)
    pixels[:, 90, 100] = 4000
    np.save(tmp_path / "movie.npy", pixels)
    known = MetadataSettings(gain="auto", offset="auto")
    movie = open_movie(convert(tmp_path / "movie.npy", tmp_path / "movie.zarr", metadata=known))
    summed = sum_stage(movie, None, tmp_path / "sum.zarr", lambda: None)
    assert summed["exposure"][90, 100] == 0
    around = summed["image"][88:93, 98:103]
    assert float(around.min()) < float(around[2, 2]) < float(around.max())


def test_frames_that_are_left_out_make_no_pattern():
    counts, _, _ = frames_of(n=24, shape=(128, 128))
    used = ~np.isin(np.arange(24), [6, 14, 15, 16, 17, 18])
    found = _pattern(Recorded(pixels=counts), used, 0.0)
    assert abs(found.value) < 4 * found.stderr


@pytest.mark.parametrize("size", [0.0, 0.05])
def test_a_fixed_pattern_is_told(size):
    """Budget: its size within 10 %, from 40 frames of 8 electrons."""
    counts, drift, rng = frames_of()
    camera = measured(counts * rng.normal(1, size, SHAPE).astype(np.float32), drift)
    assert camera.fixed_pattern == pytest.approx(size, rel=0.1)
    assert (pattern_words(camera) is not None) == (size > 0)
    assert Camera.of(camera.to_attribute()) == camera


def test_still_columns_as_fine_as_a_pattern_are_no_warning():
    """The fits on the summed image tell how much of a pattern they look like."""
    side, level = 96, 100.0
    fit = np.array([[level, x, y, 0.7, 0.7, 0.0, level] for x, y in _fine_places(side)])
    tracks = xr.Dataset({"fit_ref": (("column_id", "parameter"), fit)}, attrs={"reference_blur_px": 0.0})
    still = np.zeros((24, 2))
    pixels = np.repeat(level * _fine_columns(side)[None], 24, axis=0)
    seen = _pattern(Recorded(pixels=pixels), still[:, 0] == 0, 0.0)
    camera = Camera(pattern=seen.value, pattern_stderr=seen.stderr)
    assert pattern_words(camera)
    assert pattern_words(camera, fine_columns(tracks, still, (side, side))) is None
    assert fine_columns(tracks, np.arange(48.0).reshape(24, 2), (side, side)) == 0
    wide = tracks.assign(fit_ref=tracks["fit_ref"] * [1, 1, 1, 3, 3, 1, 1])
    assert fine_columns(wide, still, (side, side)) == 0


def _fine_places(side):
    return 6.3 * np.stack(np.meshgrid(*[np.arange(side // 6.3)] * 2), axis=-1).reshape(-1, 2) + 2.2


def _fine_columns(side):
    """Columns with a sigma of 0.7 px, as high as the background, (y, x)."""
    axis = np.arange(side)
    y, x = (np.exp(-((axis - at[:, None]) ** 2) / 2 / 0.7**2) for at in _fine_places(side)[:, ::-1].T)
    return 1 + np.einsum("cy,cx->yx", y, x)
