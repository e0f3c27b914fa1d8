"""Shifts of noisy images against known truth, and the properties that they rest on."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tract_dask.kernels.alignment import EDGE, Template, align, moments
from tract_dask.kernels.alignment import correlation as correlation_of
from tract_dask.kernels.registration import (
    _products,
    _products_by_fft,
    _window_sums,
    clean_image,
    correlation,
    fast_length,
    fold_image,
    measure_spectrum,
    search,
)
from tract_dask.kernels.sums import add_frames, add_shifted, coverage, overlap

PERIOD = 24.0


def lattice(shape=(120, 100), shift=(0.0, 0.0), step=0.0):
    """Round columns on a square lattice, less their mean; ``step`` darkens the upper half."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    phase_y, phase_x = (2 * np.pi * (u - s) / PERIOD for u, s in ((y, shift[0]), (x, shift[1])))
    image = np.exp(2.0 * (np.cos(phase_y) + np.cos(phase_x)) - 4.0)
    image += step / (1 + np.exp((shape[0] / 2 - y + shift[0]) / 2))
    return (image - image.mean()).astype(np.float32)


def template_of(image, exposure=None):
    """A template of one frame, or of a sum with its exposure; nearly every frequency passes its filter."""
    exposure = np.ones_like(image) if exposure is None else exposure
    return Template(image, exposure, np.array([0.0, 0.45, 0.5]), np.array([1.0, 1.0, 0.0]))


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


@pytest.mark.parametrize(("lags", "shape"), [(7, (40, 33)), (9, (64, 50))])
def test_every_way_to_compare_gives_the_same(lags, shape):
    rng = np.random.default_rng(5)
    piece, under = (rng.normal(size=(n + k, m + k)).astype("f4") for n, m, k in [(*shape, 0), (*shape, lags - 1)])
    windows = np.lib.stride_tricks.sliding_window_view(under.astype(float), shape)
    expected = np.einsum("ijyx,yx->ij", windows, piece)
    np.testing.assert_allclose(_products(piece, under, lags), expected, atol=1e-3)
    np.testing.assert_allclose(_products_by_fft(piece, under, lags), expected, atol=1e-3)
    sums, squares = _window_sums(under, lags)
    np.testing.assert_allclose(sums, windows.sum(axis=(2, 3)), atol=1e-9)
    np.testing.assert_allclose(squares, (windows**2).sum(axis=(2, 3)), rtol=1e-9)


def test_align_reaches_the_bound():
    truth, noise, n = (0.37, -0.21), 1.0, 60
    rng, template = np.random.default_rng(0), template_of(lattice())
    clean = lattice(shift=truth)
    found = np.array(
        [align(clean + rng.normal(0, noise, clean.shape).astype("f4"), template, (0, 0), limit=3)[:2] for _ in range(n)]
    )
    bound = np.array(position_bound(clean, noise))
    assert (found.std(axis=0) <= 1.25 * bound).all()
    assert (np.abs(found.mean(axis=0) - truth) <= 4 * bound / np.sqrt(n)).all()


@settings(deadline=None)  # the first example compiles
@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(0.2, 5), st.floats(-10, 10))
def test_align_does_not_depend_on_brightness(dy, dx, scale, offset):
    frame = (scale * lattice(shift=(dy, dx)) + offset).astype(np.float32)
    fit = align(frame, template_of(lattice()), (0.0, 0.0), limit=6)
    assert fit.converged
    assert (fit.dy, fit.dx) == pytest.approx((dy, dx), abs=0.02)  # at its edges the filter sees one side only
    assert fit.correlation == pytest.approx(1.0, abs=3e-3)  # single precision, over an offset of 50 amplitudes


@pytest.mark.parametrize("shift", [(0.5, 0.25), (0.3, -0.49), (-0.125, 0.0)])
def test_align_is_exact_for_fine_structure(shift):
    """Waves of four pixels, which a cubic through the pixels themselves would pull towards them."""
    y, x = np.mgrid[:128, :128]
    scene, frame = (
        (np.cos(np.pi / 2 * (y - dy)) + np.cos(np.pi / 2 * (x - dx))).astype("f4") for dy, dx in ((0, 0), shift)
    )
    fit = align(frame, template_of(scene), (0.0, 0.0), limit=1)
    assert (fit.dy, fit.dx) == pytest.approx(shift, abs=0.01)


def test_align_ignores_what_few_frames_show():
    """The upper third of the sum is of one frame in five, with something else in it."""
    image, exposure = 5.0 * lattice(), np.full((120, 100), 5.0, np.float32)
    image[:40], exposure[:40] = lattice(shift=(12.0, 12.0))[:40], 1.0
    fit = align(lattice(shift=(0.5, 0.25)), template_of(image, exposure), (0.0, 0.0), limit=3)
    assert (fit.dy, fit.dx) == pytest.approx((0.5, 0.25), abs=0.05)


@settings(deadline=None)  # the first example compiles
@given(st.floats(-1, 1), st.floats(-1, 1))
def test_align_ends_wherever_the_shift_is(dy, dx):
    """Noise as strong as the structure, in a small field: which pixels are compared must not flicker."""
    rng = np.random.default_rng(3)
    frame = lattice((48, 40), (dy, dx)) + rng.normal(0, 0.2, (48, 40)).astype("f4")
    assert align(frame, template_of(lattice((48, 40))), (round(dy), round(dx)), limit=5).converged


@pytest.mark.parametrize("frame", [np.zeros((120, 100)), -lattice()])
def test_align_says_when_it_fails(frame):
    fit = align(frame.astype(np.float32), template_of(lattice()), (0.3, 0.1), limit=1)
    assert not fit.converged
    assert (fit.dy, fit.dx) == (0.3, 0.1)
    assert fit.correlation <= 0.0


def test_align_stays_within_its_limit():
    frame = lattice(shift=(4.0, 0.0))
    fit = align(frame, template_of(lattice()), (0.0, 0.0), limit=1.0)
    assert not fit.converged
    assert (fit.dy, fit.dx) == (0.0, 0.0)


def test_moments_match_numpy_at_whole_pixels():
    rng = np.random.default_rng(1)
    frame, image = rng.normal(size=(2, 30, 40)).astype(np.float32)
    samples = np.zeros((60, 2, 40), np.float32)
    samples[::2, 0] = image
    sums = moments(frame, samples, np.ones_like(image), (2.0, -3.0), (2, -3))
    piece, under = frame[2 + EDGE : 30, 0 : 37 - EDGE], image[EDGE:28, 3 : 40 - EDGE]
    assert sums[0] == piece.size
    assert sums[6] == pytest.approx(float((piece * under).sum()), rel=1e-4)
    assert correlation_of(sums) == pytest.approx(float(np.corrcoef(piece.ravel(), under.ravel())[0, 1]), abs=1e-5)


def test_correlation_at_whole_pixels_is_pearsons():
    frame, image = np.random.default_rng(1).normal(size=(2, 30, 40)).astype(np.float32)
    expected = np.corrcoef(frame[2:30, 0:37].ravel(), image[0:28, 3:40].ravel())[0, 1]
    assert correlation(frame, image, (2, -3)) == pytest.approx(expected, abs=1e-6)


def test_correlation_without_overlap_is_zero():
    assert correlation(lattice(), lattice(), (200, 0)) == 0.0
    assert correlation(np.ones((5, 5), np.float32), lattice(), (0, 0)) == 0.0


def test_template_is_the_mean_where_it_is_known():
    image, exposure = np.full((40, 50), 6.0, np.float32), np.full((40, 50), 3.0, np.float32)
    image[:15], exposure[:15] = 2.0, 1.0
    template = Template(image, exposure, np.array([0.0, 0.3, 0.4]), np.array([1.0, 1.0, 0.0]))
    assert template.weight[:13].max() == 0.0
    assert template.weight[17:].min() == 1.0
    np.testing.assert_allclose(template.samples[34:], 2.0, atol=0.1)
    assert 0.3 < template.noise_passed < 0.5


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


def test_clean_image_replaces_what_is_no_number():
    raw = np.array([[1.0, np.nan, 3.0], [np.inf, 5.0, -np.inf]])
    image, shows_anything = clean_image(raw)
    np.testing.assert_array_equal(image, [[1, 3, 3], [3, 5, 3]])
    assert image.dtype == np.float32
    assert shows_anything
    for blank in (np.full((4, 4), 7, np.uint16), np.full((4, 4), np.nan), np.array([[2.0, np.nan]])):
        image, shows_anything = clean_image(blank)
        assert np.isfinite(image).all()
        assert not shows_anything


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "int16", "float32", "bool"])
def test_add_frames_is_one_add_shifted_after_the_other(dtype):
    rng = np.random.default_rng(6)
    frames = rng.integers(0, 100, (5, 12, 9)).astype(dtype)
    shifts = np.array([[0, 0], [3, -2], [-4, 8], [30, 0], [-2, -9]])
    expected, total = np.zeros((2, 10, 11), np.int64)
    for frame, shift in zip(frames, shifts, strict=True):
        add_shifted(expected, frame.astype(np.int64), shift)
    add_frames(total, frames, shifts)
    np.testing.assert_array_equal(total, expected)


def test_coverage_counts_moved_frames():
    shifts, ones = np.array([[0, 0], [2, -3], [-5, 1], [40, 0]]), np.ones((8, 9), np.int64)
    expected = np.zeros((8, 9), np.int64)
    for shift in shifts:
        add_shifted(expected, ones, shift)
    np.testing.assert_array_equal(coverage((8, 9), shifts), expected)


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
