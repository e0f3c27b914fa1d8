"""Columns of two grains in one image are found, also where both together show a lattice that neither has."""

import numpy as np
import pytest
import xarray as xr
from scipy.spatial import cKDTree

from tract_dask import find_columns
from tract_dask.stages.columns.grains import beside_all
from tract_dask.stages.columns.relief import Relief

SHAPE = (180, 230)
SIGMA = 4.0


def grain(spacing: float, degrees: float, square: bool) -> np.ndarray:
    """Sites of a lattice, square or hexagonal, over the whole image."""
    angles = np.deg2rad([degrees, degrees + (90 if square else 60)])
    steps = spacing * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    sites = np.mgrid[-20:21, -20:21].reshape(2, -1).T @ steps + [SHAPE[1] / 2 + 0.7, SHAPE[0] / 2 - 1.1]
    return sites[((sites > 0) & (sites < SHAPE[::-1])).all(axis=1)]


def two_grains(left: np.ndarray, right: np.ndarray, border: float, apart: float) -> np.ndarray:
    """What lies on both sides of a border along y; columns of the second grain keep apart from the first."""
    left, right = left[left[:, 0] < border], right[right[:, 0] >= border]
    return np.concatenate([left, right[cKDTree(left).query(right)[0] > apart]])


def image_of(places: np.ndarray, seed: int) -> xr.Dataset:
    y, x = np.arange(SHAPE[0])[:, None], np.arange(SHAPE[1])
    down, across = (np.exp(-((axis - places[:, k, None, None]) ** 2) / (2 * SIGMA**2)) for axis, k in ((y, 1), (x, 0)))
    expected = 3.2 + 1.6 * np.einsum("nyi,nix->yx", down, across)
    image = np.random.default_rng(seed).poisson(30 * expected) / 30
    return xr.Dataset({"image": (("y", "x"), image), "exposure": (("y", "x"), np.full(SHAPE, 30, "u4"))})


@pytest.mark.parametrize(
    ("spacings", "degrees", "square", "border"),
    [((31, 31), (7, 37), False, 115), ((30, 30), (3, 48), True, 110)],
)
def test_columns_of_both_grains_are_found(spacings, degrees, square, border):
    grains = [grain(spacing, turned, square) for spacing, turned in zip(spacings, degrees, strict=True)]
    true = two_grains(*grains, border, 21.0)
    columns = find_columns(image_of(true, border))
    found = np.stack([columns["x_ref"], columns["y_ref"]], axis=1)
    inside = ((true > 18) & (true < np.array(SHAPE[::-1]) - 18)).all(axis=1)
    assert (cKDTree(found).query(true[inside])[0] < 1.5).all()
    assert (cKDTree(true).query(found)[0] < 3.0).all()


def test_peaks_near_columns_or_of_what_was_left_out_are_not_added():
    height = np.zeros((60, 90), np.float32)
    for y, x, value in ((30, 15, 1.0), (30, 45, 1.0), (30, 60, 0.9), (12, 75, 0.8), (45, 75, 0.3), (12, 30, 0.9)):
        height[y - 1 : y + 2, x - 1 : x + 2] = value / 2
        height[y, x] = value
    relief = Relief(height, np.ones(height.shape, bool), 0.01, 1)
    columns = np.array([[15.0, 30.0], [45.0, 30.0]])
    assert beside_all(relief, 30.0, columns, []).tolist() == [[30.0, 12.0], [75.0, 12.0]]
    assert beside_all(relief, 30.0, columns, [np.array([[30.0, 12.0]])]).tolist() == [[75.0, 12.0]]
    assert len(beside_all(relief, 30.0, np.array([[70.0, 50.0]]), [])) == 0
