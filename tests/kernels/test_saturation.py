"""Full scale is found where pixels are cut off, and nowhere else."""

import numpy as np
import pytest

from tract_dask.kernels.defects import Moments, look_back
from tract_dask.kernels.saturation import full_scale

SHAPE = (90, 96)


def levels(amplitude, background):
    """Expected counts of a field of columns."""
    y, x = (np.exp(-0.5 * ((np.arange(side) % 24 - 11.3) / 4.0) ** 2) for side in SHAPE)
    return background + amplitude * np.outer(y, x)


def found(frames):
    return full_scale(np.sort(frames.astype(np.float32), axis=0)[-2], frames[0], np.ones(SHAPE, bool))


def counts(amplitude, background, n_frames=12):
    return np.random.default_rng(0).poisson(levels(amplitude, background), (n_frames, *SHAPE))


@pytest.mark.parametrize(
    ("level", "offset", "cut_off"),
    [((60, 20), 0, 63), ((900, 300), -40, 760), ((5e4, 1e4), 0, 40_000), ((4, 2), 0, 3), ((60, 20), 0, 30)],
)
def test_full_scale_is_where_pixels_are_cut_off(level, offset, cut_off):
    frames = np.minimum(counts(*level) + offset, cut_off)
    assert found(frames) == cut_off
    assert found(frames.astype(np.float32)) == cut_off


@pytest.mark.parametrize("level", [(60, 20), (900, 300), (5e4, 1e4), (2, 1), (0.05, 0.01)])
def test_counts_that_are_not_cut_off_have_none(level):
    assert found(counts(*level)) is None
    assert found(7.3 * counts(*level) + 100) is None


def test_a_counting_camera_of_one_bit_at_a_low_dose_has_none():
    assert found(np.minimum(counts(0.3, 0.1), 1)) is None


def test_frames_without_noise_have_none():
    still = np.repeat(np.rint(levels(200, 30))[None], 4, axis=0)
    assert found(still) is None
    assert found(np.full((4, *SHAPE), 5.0)) is None


def test_a_level_into_which_dark_columns_fade_is_not_full_scale():
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]] % 24 - 11.7
    dark = 1 - 0.5 * np.exp(-(y**2 + x**2) / (2 * 2.5**2))
    for scale in (1.0, 200.0, 1000.0, 30_000.0):
        image = np.float32(dark) if scale == 1 else np.rint(scale * dark)
        assert found(np.repeat(image[None], 4, axis=0)) is None


def test_a_flat_image_with_hardly_any_noise_is_cut_off():
    flat = np.random.default_rng(0).normal(254.5, 0.7, (9, *SHAPE))
    assert found(np.minimum(np.rint(flat), 255)) == 255


def cut_off_after(frames):
    """How many pixels are cut off where a gain reference has corrected the frames."""
    gain = np.random.default_rng(2).normal(1, 0.05, SHAPE).astype(np.float32)
    moments = Moments(SHAPE)
    for number, frame in enumerate(frames):
        moments.add((frame * gain).astype(np.float32), follows=number > 0)
    history = look_back(moments)
    assert history.full_scale is None
    return history.cut_off


@pytest.mark.parametrize(("level", "top"), [((60, 20), 60), ((900, 300), 1000), ((5e4, 1e4), 4e4)])
def test_pixels_that_were_cut_off_before_a_gain_correction_are_seen(level, top):
    """Most of those that are cut off in the mean; none that stay below by five standard deviations."""
    found, mean = cut_off_after(np.minimum(counts(*level, 24), top)), levels(*level)
    assert 0.5 * (mean > top).sum() < found < 1.5 * (mean > top - 2 * np.sqrt(top)).sum()


@pytest.mark.parametrize("n_frames", [8, 32])
@pytest.mark.parametrize("level", [(60, 20), (-18, 20), (900, 300), (2, 1), (0.3, 0.1), (0.1, 0.03)])
def test_nothing_is_cut_off_in_counts_that_a_gain_reference_corrected(level, n_frames):
    assert cut_off_after(counts(*level, n_frames)) == 0
