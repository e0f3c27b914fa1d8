"""Grey levels of images, against values counted by hand."""

import numpy as np

from tract_dask.kernels.greys import block_means, contrast, grey_levels


def test_grey_levels_run_from_low_to_high():
    seen = np.array([[-1, 0, 2.5, 5, 10, 99, np.nan]], np.float32)
    np.testing.assert_array_equal(grey_levels(seen, 0, 10), [[1, 1, 64 + 1, 128, 255, 255, 0]])
    usual = np.arange(1001.0, dtype=np.float32)[None]
    shown = grey_levels(usual)  # black and white at percentiles 0.5 and 99.5
    assert (shown[0, 5], shown[0, 500], shown[0, 995]) == (1, 128, 255)
    assert set(grey_levels(np.zeros((2, 2), np.float32)).ravel()) == {1}


def test_an_image_without_pixels_is_transparent():
    nothing = np.full((2, 3), np.nan)
    assert contrast(nothing) == (0.0, 1.0)
    np.testing.assert_array_equal(grey_levels(nothing), np.zeros((2, 3)))


def test_blocks_are_means_of_the_pixels_that_are_known():
    image = np.array([[1, 3, 5], [np.nan, 8, np.nan], [np.nan, np.nan, 7]])
    np.testing.assert_allclose(block_means(image, 2), [[4, 5], [np.nan, 7]])
    np.testing.assert_array_equal(block_means(image, 1), image)
