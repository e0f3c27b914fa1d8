"""Displaced rows of scanned frames, against known offsets and the bound of their errors."""

import numpy as np
import pytest

from tract_dask.kernels.scan_rows import displaced_rows

HEIGHT, AMPLITUDE, BACKGROUND = 160, 80.0, 20.0


def columns_of(sigma):
    """Columns of a turned lattice, so that they meet all rows: (n, 7)."""
    step = np.arange(-20, 20) * 7.0 * sigma
    grid = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    place = grid @ [[0.97, 0.24], [-0.24, 0.97]] + HEIGHT / 2
    place = place[((place > 4 * sigma) & (place < HEIGHT - 4 * sigma)).all(axis=1)]
    columns = np.tile([AMPLITUDE, 0, 0, sigma, sigma, 0, BACKGROUND], (len(place), 1))
    columns[:, 1:3] = place
    return columns


def heights_and_slopes(columns, offset):
    """Return what columns add to the pixels of displaced rows, and its slope along x, (n, rows, columns)."""
    x, y = np.arange(HEIGHT), np.arange(HEIGHT)[:, None]
    dx = x - columns[:, 1, None, None] - offset[:, None]
    squares = (dx**2 + (y - columns[:, 2, None, None]) ** 2) / columns[:, 3, None, None] ** 2
    height = AMPLITUDE * np.exp(-squares / 2)
    return height, height * dx / columns[:, 3, None, None] ** 2


def seen(sigma, offset, own=0.0, seed=0):
    """Return an image, and its columns as fits see them: displaced as their rows, and as wide."""
    columns = columns_of(sigma)
    true = columns.copy()
    true[:, 1] += own
    height, slope = heights_and_slopes(true, offset)
    image = np.random.default_rng(seed).poisson(BACKGROUND + height.sum(axis=0)).astype(float)
    columns[:, 1] = true[:, 1] + (slope**2 * offset[:, None]).sum(axis=(1, 2)) / (slope**2).sum(axis=(1, 2))
    wide = np.hypot(sigma, offset.std())
    columns[:, 3], columns[:, 0] = wide, AMPLITUDE * sigma / wide
    return image, columns, true


def window(sigma):
    return 2 * int(3 * sigma) + 1


@pytest.mark.parametrize(("sigma", "alike"), [(1.5, 0.0), (3.0, 0.0), (3.0, 0.95)])
def test_half_of_the_columns_tell_offsets_to_their_bound(sigma, alike):
    """Within 1.2 of the bound of the pixels of all rows, and as the stated errors say, for narrow columns too."""
    rng, offset = np.random.default_rng(1), np.empty(HEIGHT)
    offset[0] = rng.normal(0, 1.3)
    for k in range(1, HEIGHT):
        offset[k] = alike * offset[k - 1] + rng.normal(0, 1.3 * np.sqrt(1 - alike**2))
    offset -= offset.mean()
    image, columns, true = seen(sigma, offset)
    half = np.arange(len(columns)) % 2 == 0
    found = displaced_rows(image, np.where(half[:, None], columns, np.nan), true[:, 1], window(sigma), counting=True)
    height, slope = heights_and_slopes(true, offset)
    told = ((slope[half].sum(axis=0)) ** 2 / (BACKGROUND + height.sum(axis=0))).sum(axis=1)
    known = told > 1 / 0.5**2
    error = found.offset - offset
    assert known.mean() > 0.7
    assert np.sqrt((error[known] ** 2).mean()) < 1.2 * np.sqrt((1 / told[known]).mean())
    assert (error / np.sqrt(found.variance)).std() == pytest.approx(1, abs=0.2)
    assert np.isnan(found.x[~half]).all()


@pytest.mark.parametrize("own", [0.0, 0.3])
def test_columns_are_where_they_would_be_without_offsets(own):
    """Columns that are displaced by themselves stay so."""
    rng = np.random.default_rng(2)
    offset, moved = rng.normal(0, 1.3, HEIGHT), own * rng.normal(0, 1, len(columns_of(3.0)))
    image, columns, true = seen(3.0, offset, moved)
    found = displaced_rows(image, columns, columns_of(3.0)[:, 1], window(3.0), counting=True)
    error = found.x - true[:, 1]
    assert error.std() < 0.4 * (columns[:, 1] - true[:, 1]).std()
    assert (error / np.sqrt(found.x_variance)).std() == pytest.approx(1, abs=0.25)


def test_a_column_that_moved_does_not_move_its_rows():
    offset = np.random.default_rng(3).normal(0, 0.5, HEIGHT)
    own = np.zeros(len(columns_of(3.0)))
    own[20] = 4.0
    image, columns, true = seen(3.0, offset, own)
    found = displaced_rows(image, columns, columns_of(3.0)[:, 1], window(3.0), counting=True)
    assert abs(found.x[20] - true[20, 1]) < 5 * np.sqrt(found.x_variance[20])
    assert (found.x - true[:, 1]).std() < 0.15


def test_rows_that_are_not_displaced_stay():
    image, columns, true = seen(3.0, np.zeros(HEIGHT))
    found = displaced_rows(image, columns, true[:, 1], window(3.0), counting=True)
    assert np.abs(found.offset).max() < 0.1
    assert (found.offset / np.sqrt(found.variance)).std() < 1.2


def test_missing_pixels_do_not_count():
    offset = np.random.default_rng(4).normal(0, 1.0, HEIGHT)
    image, columns, true = seen(3.0, offset)
    image[:, 90:110] = np.nan
    image[50] = np.nan
    found = displaced_rows(image, columns, true[:, 1], window(3.0), counting=True)
    assert np.isfinite(found.offset).all()
    assert found.variance[50] > 2 * np.median(found.variance)


def test_two_columns_at_least_say_where_they_belong():
    image, columns, true = seen(3.0, np.zeros(HEIGHT))
    home = np.full(len(columns), np.nan)
    home[0] = true[0, 1]
    found = displaced_rows(image, columns, home, window(3.0), counting=False)
    assert np.isnan(found.offset).all()
    assert np.isnan(found.x).all()
