"""Pixels without data are found, and atomic columns of any width, dose and contrast are not taken for them."""

from __future__ import annotations

import numpy as np
import pytest

from tract_dask.kernels.borders import shown_part
from tract_dask.kernels.defects import DEAD, HOT, LINE, Moments, find_spikes, look_at_few, look_back

SHAPE, FRAMES = (120, 132), 32


def columns(sigma, amplitude, background, seed=0):
    """Expected counts of drifting frames with columns at random places on a grid, (frames, y, x)."""
    rng = np.random.default_rng(seed)
    drift = np.cumsum(rng.normal(0, 0.3, (FRAMES, 2)), axis=0)
    centres = [np.arange(8 * sigma, side, 8 * sigma) for side in SHAPE]
    centres = [middle + rng.uniform(-0.5, 0.5, middle.size) for middle in centres]

    def along(side, middle):
        return np.exp(-0.5 * ((np.arange(side)[:, None] - middle) / sigma) ** 2).sum(axis=1)

    placed = ((centres[0] + dy, centres[1] + dx) for dy, dx in drift)
    shapes = [(along(SHAPE[0], y), along(SHAPE[1], x)) for y, x in placed]
    return np.array([background + amplitude * np.outer(*shape) for shape in shapes])


def look(frames):
    moments = Moments(frames.shape[1:])
    for k, frame in enumerate(frames):
        moments.add(frame, follows=k > 0)
    return look_back(moments)


def faulty(rng, n):
    mask = np.zeros(SHAPE, bool)
    mask.ravel()[rng.choice(mask.size, n, replace=False)] = True
    return mask


@pytest.mark.parametrize("sigma", [0.8, 1.5, 5.0])
@pytest.mark.parametrize(
    ("amplitude", "background"), [(1e4, 0.0), (1e4, 1e3), (100, 10), (3, 3), (0.2, 0.05), (-0.8, 1.0), (-90, 100)]
)
def test_atomic_columns_are_no_defects(sigma, amplitude, background):
    rng = np.random.default_rng(1)
    frames = rng.poisson(np.clip(columns(sigma, amplitude, background), 0, None)).astype(np.uint16)
    history = look(frames)
    assert not history.mask.any()
    assert sum(len(find_spikes(frame, history)) for frame in frames) == 0


@pytest.mark.parametrize(
    ("n", "value", "kind"), [(1, 2000, HOT), (10, 200, HOT), (60, 65535, HOT), (60, 40, HOT), (60, 0, DEAD)]
)
def test_static_pixels_are_found(n, value, kind):
    rng = np.random.default_rng(2)
    frames = rng.poisson(columns(5.0, 1.44, 3.2)).astype(np.uint16)
    mask = faulty(rng, n)
    frames[:, mask] = value
    found = look(frames).mask
    assert (found[mask] == kind).mean() > 0.98
    assert not found[~mask].any()


def test_a_gain_pattern_of_8_percent_is_none():
    rng = np.random.default_rng(3)
    frames = rng.poisson(columns(5.0, 14.4, 32)) * rng.normal(20, 1.6, SHAPE)
    assert not look(frames.astype(np.float32)).mask.any()


def test_spikes_of_single_frames_are_found():
    rng = np.random.default_rng(4)
    frames = rng.poisson(columns(5.0, 1.44, 3.2)).astype(np.uint16)
    masks = [faulty(rng, 10) for _ in frames]
    for frame, mask in zip(frames, masks, strict=True):
        frame[mask] = rng.integers(40, 4000, 10)
    history = look(frames)
    assert not history.mask.any()
    for frame, mask in zip(frames, masks, strict=True):
        y, x = find_spikes(frame, history).T
        assert mask[y, x].all()
        assert len(y) >= 9


def test_lines_and_still_borders_are_found():
    rng = np.random.default_rng(5)
    frames = rng.poisson(columns(5.0, 1.44, 3.2)).astype(np.uint16)
    lines = np.zeros(SHAPE, bool)
    lines[50], lines[:, 70:73], lines[:, :9] = True, True, True
    frames[:, lines] = 0
    frames[:, 50] = 7
    found = look(frames).mask
    np.testing.assert_array_equal(found == LINE, lines)
    assert not found[~lines].any()


@pytest.mark.parametrize("value", [0.0, 100.0])
def test_a_moving_border_is_found_with_the_pixels_that_are_a_mixture(value):
    frame = np.random.default_rng(6).poisson(columns(5.0, 1.44, 3.2)[0]).astype(np.float32)
    assert shown_part(frame) is None
    frame[:7], frame[:, -3:] = value, value
    assert shown_part(frame) == (8, SHAPE[0], 0, SHAPE[1] - 4)


def test_empty_rows_at_a_low_dose_are_no_border():
    frame = np.random.default_rng(7).poisson(0.004, SHAPE)
    frame[:2] = 0
    assert shown_part(frame) is None


@pytest.mark.parametrize("whole", [True, False])
def test_vacuum_without_noise_is_no_border(whole):
    """A simulation's vacuum has one value; so has that of a counting camera where no electron came."""
    y, x = (
        np.exp(-0.5 * ((np.arange(side)[:, None] - np.arange(first, side, 24)) / 4) ** 2).sum(axis=1)
        for side, first in zip(SHAPE, (52, 12), strict=True)
    )
    level = np.outer(y, x)
    assert shown_part(np.rint(20 + 60 * level) if whole else (20 + 60 * level).astype(np.float32)) is None
    assert shown_part(np.random.default_rng(0).poisson(30 * level)) is None


def test_a_border_is_found_beside_vacuum_of_few_counts():
    frame = np.random.default_rng(1).poisson(columns(4.0, 3.0, 0.15)[0])
    frame[:, :9] = 0
    assert shown_part(frame)[2] in (9, 10, 11)


def test_a_frame_of_one_value_has_no_border():
    assert shown_part(np.zeros(SHAPE, np.uint8)) is None
    assert shown_part(np.full(SHAPE, np.nan)) is None


@pytest.mark.parametrize("n_frames", [1, 2, 5])
@pytest.mark.parametrize(("amplitude", "background", "height"), [(1.44, 3.2, 200), (300, 100, 5000), (0.2, 0.05, 40)])
def test_few_frames_show_what_is_higher_than_its_neighbours(n_frames, amplitude, background, height):
    rng = np.random.default_rng(8)
    frames = rng.poisson(columns(4.0, amplitude, background)[:n_frames])
    hot, spikes = faulty(rng, 12), np.stack([faulty(rng, 5) for _ in frames])
    frames[:, hot] = height
    frames[spikes] = height
    history = look_at_few(frames)
    if n_frames > 1:
        np.testing.assert_array_equal(history.mask > 0, hot)
    seen = np.zeros(frames.shape, bool)
    for frame, each in zip(frames, seen, strict=True):
        each[tuple(find_spikes(frame, history).T)] = True
    assert not (seen & ~(spikes | hot)).any()
    assert (seen | (history.mask > 0))[spikes | hot].mean() > 0.9


@pytest.mark.parametrize("sigma", [0.8, 5.0])
@pytest.mark.parametrize(("amplitude", "background"), [(1e4, 0.0), (100, 10), (3, 3), (0.2, 0.05), (-90, 100)])
def test_few_frames_show_columns_and_no_defects(sigma, amplitude, background):
    expected = np.clip(columns(sigma, amplitude, background)[:2], 0, None)
    for frames in (np.random.default_rng(9).poisson(expected), np.random.default_rng(9).poisson(expected)[:1]):
        history = look_at_few(frames)
        assert not history.mask.any()
        assert sum(len(find_spikes(frame, history)) for frame in frames) == 0


def test_frames_without_noise_have_no_defects():
    frames = np.repeat(columns(5.0, 10, 3)[:1], 8, axis=0)
    assert look(frames.astype(np.float32)) is None
