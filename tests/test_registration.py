"""Shifts of noisy images against known truth, and the properties that they rest on."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tract_dask.kernels.registration import (
    LowPass,
    add_shifted,
    align,
    correlation,
    fast_length,
    fold_image,
    measure_spectrum,
    moments,
    overlap,
    search,
)

PERIOD = 24.0


def lattice(shape=(120, 100), shift=(0.0, 0.0), step=0.0):
    """Round columns on a square lattice, less their mean; ``step`` darkens the upper half."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    phase_y, phase_x = (2 * np.pi * (u - s) / PERIOD for u, s in ((y, shift[0]), (x, shift[1])))
    image = np.exp(2.0 * (np.cos(phase_y) + np.cos(phase_x)) - 4.0)
    image += step / (1 + np.exp((shape[0] / 2 - y + shift[0]) / 2))
    return (image - image.mean()).astype(np.float32)


def position_bound(image, noise):
    """Cramer-Rao bound of a shift with white noise, px, per axis."""
    return [noise / np.sqrt((gradient**2).sum()) for gradient in np.gradient(image.astype(float))]


@pytest.mark.parametrize("step", [0.0, 2.0])
def test_search_finds_a_shift_near_the_guess(step):
    truth = (6.4, -5.3)
    dy, dx, score = search(lattice(shift=truth, step=step), lattice(step=step), (4.0, -3.0), 0.4 * PERIOD)
    assert (dy, dx) == pytest.approx(truth, abs=0.1)
    assert score > 0.97


def test_search_never_leaves_its_radius():
    """A jump by a lattice vector looks like no jump at all, and that is what is found."""
    frame = lattice(shift=(PERIOD + 1.0, 2.0))
    assert search(frame, lattice(), (0.0, 0.0), 0.4 * PERIOD)[:2] == pytest.approx((1.0, 2.0), abs=0.1)
    dy, dx, _ = search(lattice(shift=(9.0, 0.0)), lattice(), (0.0, 0.0), 5.0)
    assert np.hypot(dy, dx) <= 5.01


def test_search_without_overlap_returns_the_guess():
    assert search(lattice(), lattice(), (100.0, 0.0), 5.0) == (100.0, 0.0, 0.0)


def test_align_reaches_the_bound():
    truth, noise, n = (0.37, -0.21), 1.0, 60
    rng, template = np.random.default_rng(0), lattice()
    clean, weight = lattice(shift=truth), np.ones_like(template)
    found = np.array(
        [
            align(clean + rng.normal(0, noise, clean.shape).astype("f4"), template, weight, (0, 0), limit=3)[:2]
            for _ in range(n)
        ]
    )
    bound = np.array(position_bound(clean, noise))
    assert (found.std(axis=0) <= 1.3 * bound).all()
    assert (np.abs(found.mean(axis=0) - truth) <= 4 * bound / np.sqrt(n)).all()


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.2, 5), st.floats(-10, 10))
def test_align_does_not_depend_on_brightness(dy, dx, scale, offset):
    frame = (scale * lattice(shift=(dy, dx)) + offset).astype(np.float32)
    fit = align(frame, lattice(), np.ones_like(frame), (0.0, 0.0), limit=6)
    assert fit.converged
    assert (fit.dy, fit.dx) == pytest.approx((dy, dx), abs=0.02)  # the cubic's own error, below 1 % of a column's width
    assert fit.correlation == pytest.approx(1.0, abs=3e-3)  # single precision, over an offset of 50 amplitudes


def test_align_ignores_what_has_no_weight():
    frame, weight = lattice(shift=(0.5, 0.25)), np.ones((120, 100), np.float32)
    template = lattice()
    template[:40], weight[:42] = 50.0, 0.0
    fit = align(frame, template, weight, (0.0, 0.0), limit=3)
    assert (fit.dy, fit.dx) == pytest.approx((0.5, 0.25), abs=0.02)


@pytest.mark.parametrize("frame", [np.zeros((120, 100)), -lattice()])
def test_align_says_when_it_fails(frame):
    fit = align(frame.astype(np.float32), lattice(), np.ones((120, 100), np.float32), (0.3, 0.1), limit=1)
    assert not fit.converged
    assert (fit.dy, fit.dx) == (0.3, 0.1)
    assert fit.correlation <= 0.0


def test_align_stays_within_its_limit():
    frame = lattice(shift=(4.0, 0.0))
    fit = align(frame, lattice(), np.ones_like(frame), (0.0, 0.0), limit=1.0)
    assert not fit.converged
    assert (fit.dy, fit.dx) == (0.0, 0.0)


def test_moments_match_numpy_at_whole_pixels():
    rng = np.random.default_rng(1)
    frame, template = rng.normal(size=(2, 30, 40)).astype(np.float32)
    sums = moments(frame, template, np.ones_like(frame), 2.0, -3.0)
    piece, under = frame[3:30, 0:35], template[1:28, 3:38]  # the cubic needs a pixel before and two after
    assert sums[0] == piece.size
    assert sums[6] == pytest.approx(float((piece * under).sum()), rel=1e-4)
    assert correlation(sums) == pytest.approx(float(np.corrcoef(piece.ravel(), under.ravel())[0, 1]), abs=1e-5)


@given(st.integers(1, 40), st.integers(1, 40), st.integers(-60, 60))
def test_overlap_pairs_every_pixel_once(n_template, n_frame, shift):
    target, source = overlap(n_template, n_frame, shift)
    pairs = list(zip(range(n_template)[target], range(n_frame)[source], strict=True))
    assert pairs == [(k, k + shift) for k in range(n_template) if 0 <= k + shift < n_frame]


def test_add_shifted_moves_and_crops():
    image = np.arange(12.0).reshape(3, 4)
    total = np.zeros((3, 4))
    add_shifted(total, image, (1, -1))
    np.testing.assert_array_equal(total, [[0, 4, 5, 6], [0, 8, 9, 10], [0, 0, 0, 0]])


def test_spectrum_of_noisy_frames():
    """Period and noise do not depend on drift; the filter passes the lattice and stops the noise."""
    rng, noise = np.random.default_rng(2), 0.7
    shifts = rng.uniform(-9, 9, (8, 2))
    frames = [(lattice((160, 144), s) + rng.normal(0, noise, (160, 144))).astype(np.float32) for s in shifts]
    spectrum = measure_spectrum(frames)
    assert spectrum.period_px == pytest.approx(PERIOD, abs=1.0)
    assert spectrum.noise == pytest.approx(noise**2, rel=0.05)
    gain = np.interp([1 / PERIOD, 0.4], spectrum.frequency, spectrum.gain(8))
    assert gain[0] > 0.9
    assert gain[1] == 0.0
    assert spectrum.loss(2) < 0.1 < 0.5 < spectrum.loss(8)


def test_spectrum_of_noise_alone():
    frames = list(np.random.default_rng(3).normal(size=(4, 128, 128)).astype(np.float32))
    spectrum = measure_spectrum(frames)
    assert np.isnan(spectrum.period_px)
    assert not spectrum.signal.any()


def test_low_pass_keeps_what_it_should():
    image = lattice()
    every = LowPass(image.shape, np.array([0.0, 1.0]), np.array([1.0, 1.0]))
    np.testing.assert_allclose(every(image), image, atol=1e-5)
    only_the_mean = LowPass(image.shape, np.array([0.0, 0.02, 0.021]), np.array([1.0, 1.0, 0.0]))
    assert np.abs(only_the_mean(image)[30:-30, 30:-30]).max() < 0.2 * image.max()


def test_fold_is_a_mean_of_blocks():
    image = np.random.default_rng(4).normal(size=(9, 11)).astype(np.float32)
    expected = image[:8, :10].reshape(4, 2, 5, 2).mean(axis=(1, 3))
    np.testing.assert_allclose(fold_image(image, 2), expected, rtol=1e-6, atol=1e-7)
    assert fold_image(image, 1) is image


@given(st.integers(1, 5000))
def test_fast_lengths_are_smooth(n):
    length = fast_length(n)
    assert n <= length <= 1.25 * n + 1
    for prime in (2, 3, 5):
        while length % prime == 0:
            length //= prime
    assert length == 1
