"""Blur against scipy, and windows against blurred frames, bit for bit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.ndimage import gaussian_filter

from tract_dask.kernels.windows import Tiles, blur, cut_windows, gaussian_kernel

SCIPY_RELATIVE = 1e-5


def frames_of(dtype, shape=(2, 40, 47), seed=0):
    return (np.random.default_rng(seed).random(shape) * 200 + 1).astype(dtype)


@pytest.mark.parametrize("sigma", [0.4, 2.0, 3.7])
def test_blur_is_scipys(sigma):
    frame = frames_of("f4")[0]
    expected = gaussian_filter(frame.astype(np.float64), sigma, mode="nearest")
    np.testing.assert_allclose(blur(frame, sigma), expected, rtol=SCIPY_RELATIVE)


def test_frame_smaller_than_the_kernel_is_blurred_as_scipy_does():
    frame = frames_of("f4", (1, 3, 5))[0]
    np.testing.assert_allclose(blur(frame, 2.0), gaussian_filter(frame, 2.0, mode="nearest"), rtol=SCIPY_RELATIVE)


def test_sigma_zero_is_a_float32_copy():
    frame = frames_of("u2")[0]
    result = blur(frame, 0.0)
    assert result.dtype == np.float32
    np.testing.assert_array_equal(result, frame)


def test_kernel_is_normalised_and_symmetric():
    kernel = gaussian_kernel(2.0)
    assert kernel.shape == (17,)
    assert kernel.sum() == pytest.approx(1, abs=1e-6)
    np.testing.assert_array_equal(kernel, kernel[::-1])


@pytest.mark.parametrize(  # every pair is compiled
    ("dtype", "sigma"), [(dtype, 2.0) for dtype in ("u1", "i2", "f2", "f4", ">u2", "f8")] + [("f4", 0.0), ("f4", 0.4)]
)
def test_windows_are_those_of_the_blurred_frame(dtype, sigma):
    frames, size, gain = frames_of(dtype), 15, 1.37
    y = np.array([[0, 25, 12, 0], [25, 3, 7, 11]])
    x = np.array([[0, 32, 9, 32], [0, 1, 20, 31]])
    windows = cut_windows(frames, y, x, size, sigma, gain)
    for f in range(2):
        whole = blur(np.float32(gain) * frames[f].astype(np.float32), sigma)
        for n in range(4):
            expected = whole[y[f, n] : y[f, n] + size, x[f, n] : x[f, n] + size]
            np.testing.assert_array_equal(windows[f, n], expected)


@settings(deadline=None, max_examples=60)
@given(
    corner=st.tuples(st.integers(-60, 60), st.integers(-60, 60)),
    size=st.integers(1, 45),
    sigma=st.sampled_from([0.0, 2.0]),
)
def test_any_window_is_that_of_the_blurred_frame_or_zero(corner, size, sigma):
    frame = frames_of("u2")[0]
    y, x = corner
    window = cut_windows(frame[None], [[y]], [[x]], size, sigma)[0, 0]
    inside = min(y, x) >= 0 and y + size <= frame.shape[0] and x + size <= frame.shape[1]
    expected = blur(frame, sigma)[y : y + size, x : x + size] if inside else np.zeros((size, size))
    np.testing.assert_array_equal(window, expected)


def test_a_view_with_strides_is_read_as_its_values():
    frames = frames_of("u2")
    expected = cut_windows(np.ascontiguousarray(frames[:, ::2, ::2]), [[3], [2]], [[3], [2]], 9, 2.0)
    np.testing.assert_array_equal(cut_windows(frames[:, ::2, ::2], [[3], [2]], [[3], [2]], 9, 2.0), expected)


def test_no_windows_is_an_empty_result():
    assert cut_windows(frames_of("u2"), np.empty((2, 0)), np.empty((2, 0)), 9, 2.0).shape == (2, 0, 9, 9)


@pytest.mark.parametrize("sigma", [-1.0, np.nan, np.inf])
def test_impossible_sigma_is_refused(sigma):
    with pytest.raises(ValueError, match="sigma must be at least 0"):
        gaussian_kernel(sigma)


def test_wrong_shapes_and_pixels_are_refused():
    with pytest.raises(ValueError, match="image must be"):
        blur(np.zeros(3), 1.0)
    with pytest.raises(ValueError, match="real numbers"):
        blur(np.zeros((3, 3), complex), 1.0)
    with pytest.raises(ValueError, match="corners"):
        cut_windows(np.zeros((1, 9, 9)), [[1], [1]], [[1], [1]], 3, 1.0)
    with pytest.raises(ValueError, match="frames must be"):
        cut_windows(np.zeros((9, 9)), [[1]], [[1]], 3, 1.0)


@pytest.mark.parametrize("tile", [(40, 47), (16, 16), (7, 30), (64, 64)])
@pytest.mark.parametrize("sigma", [0.0, 2.0])
def test_windows_from_tiles_are_those_from_frames(tile, sigma):
    frames, size = frames_of("u2"), 15
    rows, columns = (-(-length // side) for length, side in zip(frames.shape[1:], tile, strict=True))
    padded = np.zeros((2, rows * tile[0], columns * tile[1]), frames.dtype)
    padded[:, :40, :47] = frames
    pixels = padded.reshape(2, rows, tile[0], columns, tile[1]).transpose(1, 3, 0, 2, 4).reshape(-1, 2, *tile)
    order = np.random.default_rng(1).permutation(rows * columns)
    place = np.argsort(order).reshape(rows, columns)
    y, x = np.array([[0, 25, 12, 13, 30]]), np.array([[0, 32, 9, 20, 1]])
    tiles = Tiles(np.ascontiguousarray(pixels[order]), place, (40, 47))
    windows = cut_windows(tiles, y, x, size, sigma, 1.3, first=1)
    np.testing.assert_array_equal(windows, cut_windows(frames[1:], y, x, size, sigma, 1.3))


def test_a_missing_tile_is_told():
    tiles = Tiles(np.ones((1, 1, 20, 20), np.uint16), np.array([[0, -1]]), (20, 40))
    assert (cut_windows(tiles, [[3]], [[3]], 9, 2.0) > 0).all()
    with pytest.raises(ValueError, match="tile that is missing"):
        cut_windows(tiles, [[3]], [[9]], 9, 2.0)
