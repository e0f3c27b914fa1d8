"""Kilaas's Wiener filter against closed forms: white noise, pure lattices, and a column off its site."""

import numpy as np
import pytest
from scipy.special import exp1

from tract_dask.kernels.wiener import radial_background, wiener


def white_noise(shape=(300, 257), seed=0):
    return (np.random.default_rng(seed).normal(0, 1, shape) + 5).astype(np.float32)


def lattice(shape, period_y=16, period_x=20):
    y, x = np.mgrid[: shape[0], : shape[1]]
    return (np.cos(2 * np.pi * y / period_y) + np.cos(2 * np.pi * x / period_x)).astype(np.float32)


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0, 3.0])
def test_the_share_of_white_noise_that_stays_is_that_of_theory(factor):
    """Power p is exponentially distributed, and ((p - a) / p)^2 p is left: exp(-a) (1 - a) + a^2 E1(a) in the mean."""
    left = wiener(white_noise(), factor, np.inf).var()
    assert left == pytest.approx(np.exp(-factor) * (1 - factor) + factor**2 * exp1(factor), rel=0.05)


def test_strong_subtraction_leaves_nothing_of_noise_but_its_mean():
    left = wiener(white_noise(), 12.0)
    assert left.std() <= 2e-3
    assert left.mean() == pytest.approx(5, abs=0.01)


@pytest.mark.parametrize("shape", [(256, 240), (240, 256), (96, 100)])
def test_a_pure_lattice_stays_as_it_is(shape):
    image = lattice(shape, shape[0] / 16, shape[1] / 12)
    np.testing.assert_allclose(wiener(image, 1.0, np.inf), image, atol=1e-5)


def test_a_lattice_in_noise_keeps_its_amplitude():
    image = lattice((256, 240)) + white_noise((256, 240))
    slope = np.polyfit(lattice((256, 240)).ravel(), wiener(image, 1.0, np.inf).ravel(), 1)[0]
    assert slope == pytest.approx(1, abs=0.01)


@pytest.mark.parametrize("strength", [0.0, 3.0])
def test_the_background_is_that_of_the_noise_whatever_the_reflections(strength):
    """White noise of variance 1 has power ny nx everywhere."""
    image = white_noise((256, 240)) + strength * lattice((256, 240))
    power = np.abs(np.fft.rfft2(image)) ** 2
    background = radial_background(power, image.shape) / image.size
    far = np.hypot(np.fft.fftfreq(256)[:, None], np.fft.rfftfreq(240)) > 0.02
    assert background[far].mean() == pytest.approx(1, abs=0.01)
    assert background[far].std() <= 0.12  # a ring of 40 values has its mean to 16 %


def test_a_background_that_depends_on_frequency_is_followed():
    """Blurred noise: the power falls as the square of the blur's transform."""
    noise = white_noise((256, 256)) - 5
    frequency = np.hypot(np.fft.fftfreq(256)[:, None], np.fft.rfftfreq(256))
    shape = np.exp(-2 * (np.pi * frequency) ** 2)
    power = np.abs(np.fft.rfft2(noise) * shape) ** 2
    ratio = radial_background(power, noise.shape) / (noise.size * shape**2)
    assert np.abs(ratio[(frequency > 0.1) & (frequency < 0.45)] - 1).mean() <= 0.05


def test_an_isolated_spot_is_weakened_and_a_periodic_one_is_not():
    """What Levin et al. saw: columns of the lattice keep their brightness, a single one off it does not."""
    y, x = np.mgrid[:240, :240]
    spots = sum(np.exp(-((x - a) ** 2 + (y - b) ** 2) / 18) for a in range(12, 240, 24) for b in range(12, 240, 24))
    lone = np.exp(-((x - 120) ** 2 + (y - 120) ** 2) / 18)
    image = (10 * spots + 10 * lone + white_noise((240, 240))).astype(np.float32)
    filtered = wiener(image, 3.0)
    level = np.median(filtered)
    assert filtered[108, 108] - level > 0.85 * 10
    assert filtered[120, 120] - level < 0.6 * 10


@pytest.mark.parametrize("cutoff", [0.3, 0.6])
def test_the_low_pass_is_butterworths(cutoff):
    """Amplitudes are divided by sqrt(1 + (f / cutoff)^4), with Nyquist's frequency as unit."""
    image = lattice((240, 240), 4, 8)  # half and quarter of it
    transform = np.abs(np.fft.rfft2(wiener(image, 1.0, cutoff)) / np.fft.rfft2(image).max())
    expected = 1 / np.sqrt(1 + (np.array([0.5, 0.25]) / cutoff) ** 4)
    np.testing.assert_allclose([transform[60, 0], transform[0, 30]], expected, rtol=1e-3)


def test_nan_spreads_and_wrong_input_is_refused():
    image = white_noise((32, 32))
    image[3, 4] = np.nan
    assert np.isnan(wiener(image)).all()
    with pytest.raises(ValueError, match="image must be"):
        wiener(np.zeros(4))
    with pytest.raises(ValueError, match="background must be"):
        wiener(np.zeros((4, 4)), -1.0)
    np.testing.assert_allclose(wiener(np.full((6, 7), 3.0)), 3.0, rtol=1e-6)
    with pytest.raises(ValueError, match="cutoff must be"):
        wiener(np.zeros((4, 4)), 1.0, 0.0)


@pytest.mark.parametrize("factor", [2.0**-90, 2.0**90])
def test_the_units_of_the_pixels_do_not_matter(factor):
    image = lattice((96, 100)) + white_noise((96, 100))
    found = wiener((image * factor).astype(np.float32))
    np.testing.assert_array_equal(found, wiener(image) * np.float32(factor))
