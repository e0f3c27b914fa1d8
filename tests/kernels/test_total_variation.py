"""TV-L1 against closed forms: discs, stripes, medians and outliers."""

import numpy as np
import pytest

from tract_dask.kernels.total_variation import total_variation

RADIUS = 8.0


def disc(side=48, height=3.0, ground=10.0):
    y, x = np.mgrid[:side, :side] - side // 2
    return (ground + height * (np.hypot(y, x) <= RADIUS)).astype(np.float32)


def objective(image, frame, fidelity):
    down, right = np.diff(image, axis=0, append=image[-1:]), np.diff(image, axis=1, append=image[:, -1:])
    return np.hypot(down, right).sum() + fidelity * np.abs(image - frame).sum()


@pytest.mark.parametrize(("share", "left"), [(0.75, 0.0), (1.35, 1.0)])
@pytest.mark.parametrize("height", [3.0, -0.01, 500.0])
def test_a_disc_stays_or_goes_by_its_radius_and_not_by_its_contrast(share, left, height):
    """It goes where the fidelity is below 2 / radius, and keeps its whole height above (Chan and Esedoglu 2005)."""
    frame = disc(height=height)
    found = total_variation(frame, share * 2 / RADIUS, max_iterations=3000, tolerance=0)
    assert (found[24, 24] - 10) / height == pytest.approx(left, abs=0.02)
    assert (found[2, 2] - 10) / height == pytest.approx(0, abs=0.02)


def test_a_wide_stripe_stays_exactly():
    frame = np.zeros((30, 40), np.float32)
    frame[:, 14:26] = 2
    np.testing.assert_allclose(total_variation(frame, 0.4, max_iterations=1000), frame, atol=2e-3)


def test_a_narrow_stripe_goes():
    """Its two edges cost 2 a row, its width times the fidelity less."""
    frame = np.zeros((30, 40), np.float32)
    frame[:, 19:22] = 2
    assert np.abs(total_variation(frame, 0.5, max_iterations=3000)).max() <= 0.02
    np.testing.assert_allclose(total_variation(frame, 0.9, max_iterations=3000), frame, atol=0.02)


def test_a_low_fidelity_leaves_the_median():
    frame = np.random.default_rng(0).exponential(2.0, (31, 33)).astype(np.float32)
    found = total_variation(frame, 0.02, max_iterations=4000, tolerance=0)
    np.testing.assert_allclose(found, np.median(frame), atol=0.02)


def test_outliers_go_without_a_trace():
    frame = disc()
    spoilt = frame.copy()
    spoilt[5, 7] = spoilt[24, 24] = 60
    clean, mended = (total_variation(image, 1.0, max_iterations=3000) for image in (frame, spoilt))
    np.testing.assert_allclose(mended, clean, atol=0.2)


def test_the_minimum_is_one():
    """No image nearby does better, to 1e-3 of the objective."""
    rng = np.random.default_rng(1)
    frame = (disc() + rng.normal(0, 1, (48, 48))).astype(np.float32)
    found = total_variation(frame, 0.8, max_iterations=3000, tolerance=0)
    least = objective(found, frame, 0.8)
    assert least < min(objective(disc(), frame, 0.8), 0.5 * objective(frame, frame, 0.8))
    for scale in (0.01, 0.1, 0.5):
        other = found + rng.normal(0, scale, found.shape)
        assert objective(other, frame, 0.8) >= least * (1 - 1e-3)
    for other in (0.9 * found + 0.1 * frame, 0.9 * found + 0.1 * disc(), found + 0.1):
        assert objective(other, frame, 0.8) >= least * (1 - 1e-3)


def test_the_defaults_come_near_the_minimum():
    frame = (disc() + np.random.default_rng(2).normal(0, 1, (48, 48))).astype(np.float32)
    near, found = (total_variation(frame, 0.9, **more) for more in ({}, {"max_iterations": 4000, "tolerance": 0}))
    assert objective(near, frame, 0.9) <= 1.003 * objective(found, frame, 0.9)


def test_flat_nan_and_wrong_input():
    flat = np.full((5, 9), 7, np.uint16)
    np.testing.assert_array_equal(total_variation(flat, 1.0), flat)
    holed = disc()
    holed[0, 0] = np.nan
    assert np.isnan(total_variation(holed, 1.0)).all()
    with pytest.raises(ValueError, match="fidelity must be positive"):
        total_variation(flat, 0.0)
    with pytest.raises(ValueError, match="image must be"):
        total_variation(np.zeros(4), 1.0)
