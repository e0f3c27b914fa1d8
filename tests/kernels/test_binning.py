"""Per-frame statistics and binned means against numpy in extended precision."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tract_dask.kernels.binning import FrameMeter

DTYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f2", "f4", "f8")
RELATIVE = 1e-10


def binned(frame, factor):
    """Return the means of the finite pixels of each bin, the slow way."""
    n_y, n_x = frame.shape
    rows = []
    for y in range(0, n_y, factor):
        parts = (frame[y : y + factor, x : x + factor].astype(np.longdouble) for x in range(0, n_x, factor))
        finite = [part[np.isfinite(part)] for part in parts]
        rows.append([part.mean() if part.size else np.nan for part in finite])
    return np.array(rows, dtype=np.float64)


def measure_frame(frame, n_levels):
    return FrameMeter(frame.shape, frame.dtype, n_levels).measure(frame)


def assert_measured(frame, n_levels):
    measures = measure_frame(frame, n_levels)
    values = frame[np.isfinite(frame)].astype(np.longdouble)
    assert measures.n_bad == frame.size - values.size
    assert measures.minimum == float(values.min())
    assert measures.maximum == float(values.max())
    scale = float(np.abs(values).max()) or 1.0
    assert measures.mean == pytest.approx(float(values.mean()), rel=RELATIVE, abs=1e-14 * scale)
    assert measures.std == pytest.approx(float(values.std()), rel=RELATIVE, abs=1e-14 * scale)
    assert len(measures.levels) == n_levels
    for level, means in enumerate(measures.levels, start=1):
        truth = binned(frame, 4**level)
        assert means.dtype == np.float32
        assert means.shape == truth.shape
        np.testing.assert_allclose(means, truth, rtol=3e-7, atol=1e-7 * scale)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("shape", [(64, 128), (37, 129), (3, 2), (1, 70)])
def test_every_pixel_type_equals_numpy(dtype, shape):
    frame = np.random.default_rng(1).poisson(60, shape).astype(dtype)
    assert_measured(frame, 3)


@pytest.mark.parametrize("dtype", [dtype for dtype in DTYPES if dtype[0] in "iu"])
def test_the_whole_range_of_integers(dtype):
    info = np.iinfo(dtype)
    frame = np.random.default_rng(2).integers(info.min, info.max, (41, 53), dtype=dtype, endpoint=True)
    frame[0, 0], frame[-1, -1] = info.min, info.max
    assert_measured(frame, 2)


@pytest.mark.parametrize("dtype", ["u2", "u4", "f8"])
def test_small_noise_on_a_large_offset_loses_no_digits(dtype):
    frame = (60000 + np.random.default_rng(3).integers(0, 2, (200, 210))).astype(dtype)
    frame[:4] = 0  # a first band that says nothing of the rest
    assert_measured(frame, 1)
    assert_measured(frame[4:], 1)


@settings(max_examples=60, deadline=None)
@given(
    st.integers(1, 40),
    st.integers(1, 40),
    st.sampled_from(["f2", "f4", "f8"]),
    st.floats(0, 0.9),
    st.integers(0, 2**32 - 1),
)
def test_bad_pixels_are_counted_and_left_out(n_y, n_x, dtype, share, seed):
    rng = np.random.default_rng(seed)
    frame = rng.normal(10, 3, (n_y, n_x)).astype(dtype)
    bad = rng.random(frame.shape) < share
    bad[rng.integers(n_y), rng.integers(n_x)] = False
    frame[bad] = rng.choice([np.nan, np.inf, -np.inf], bad.sum()).astype(dtype)
    assert_measured(frame, 2)


def test_a_frame_without_a_finite_pixel():
    measures = measure_frame(np.full((9, 9), np.nan, np.float32), 2)
    assert measures.n_bad == 81
    assert np.isnan([measures.minimum, measures.maximum, measures.mean, measures.std]).all()
    assert all(np.isnan(level).all() for level in measures.levels)


def test_a_view_is_measured_as_its_copy():
    frames = np.random.default_rng(4).poisson(9, (50, 60)).astype(np.uint16)
    view = frames[5:44, 3:58]
    assert_measured(view, 2)
    again = measure_frame(view.copy(), 2)
    assert measure_frame(view, 2)[:5] == again[:5]


def test_one_meter_measures_many_frames():
    frames = np.random.default_rng(5).poisson(9, (3, 45, 70)).astype(np.uint16)
    meter = FrameMeter(frames.shape[1:], frames.dtype, 2)
    for frame in frames:
        measures, alone = meter.measure(frame), measure_frame(frame, 2)
        assert measures[:5] == alone[:5]
        assert all(np.array_equal(one, other) for one, other in zip(measures.levels, alone.levels, strict=True))
