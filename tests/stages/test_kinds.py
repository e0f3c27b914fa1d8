"""Crystals of several sublattices: all columns that stand out are found, and each knows its kind."""

import numpy as np
import pytest
import xarray as xr
from scipy.spatial import cKDTree

from tract_dask import find_columns
from tract_dask.settings import ColumnSettings
from tract_dask.stages.columns.kinds import kinds_of
from tract_dask.stages.columns.lattice import Lattice
from tract_dask.store.columns import positions

SHAPE, FRAMES, CELL, ANGLE = (200, 230), 40, 40.0, 0.07
BUDGET_PX = 0.6
"""Of a column, from its truth: the faintest here are known to 0.2 px."""


def perovskite(amplitudes, sigma=4.0, cell=CELL, shape=SHAPE):
    """Places (n, 2), kinds and amplitudes of ABO3 along [001]: A at the corners, B in the middle, O on the sides."""
    turn = np.array([[np.cos(ANGLE), np.sin(ANGLE)], [-np.sin(ANGLE), np.cos(ANGLE)]])
    i, j = np.mgrid[-9:10, -9:10].reshape(2, -1)
    sites = {"A": ((0, 0),), "B": ((0.5, 0.5),), "O": ((0.5, 0), (0, 0.5))}
    places, kinds = [], []
    for kind, inside in sites.items():
        for u, v in inside if amplitudes.get(kind) else ():
            at = cell * np.stack([i + u, j + v], axis=1) @ turn + np.array(shape[::-1]) / 2 + 0.3
            at = at[((at > -12) & (at < np.array(shape[::-1]) + 12)).all(axis=1)]
            places.append(at)
            kinds += [kind] * len(at)
    return np.concatenate(places), np.array(kinds)


def summed(amplitudes, sigma=4.0, contrast=0.6, dose=30.0, cell=CELL, shape=SHAPE, seed=0):
    """The sum of Poisson frames of it on a background of 1, and the truth."""
    places, kinds = perovskite(amplitudes, sigma, cell, shape)
    y, x = np.mgrid[: shape[0], : shape[1]]
    image = np.ones(shape)
    for (at_x, at_y), kind in zip(places, kinds, strict=True):
        image += contrast * amplitudes[kind] * np.exp(-((x - at_x) ** 2 + (y - at_y) ** 2) / (2 * sigma**2))
    counts = np.random.default_rng(seed).poisson(image * dose * FRAMES) / FRAMES
    dataset = xr.Dataset({"image": (("y", "x"), counts), "exposure": (("y", "x"), np.full(shape, FRAMES, "u4"))})
    return dataset, places, kinds


def judged(found, places, kinds, cell=CELL, shape=SHAPE):
    """The kind found of each true column that lies well inside, by true kind; and how many are false."""
    inside = ((places > 0.4 * cell) & (places < np.array(shape[::-1]) - 0.4 * cell)).all(axis=1)
    away, which = cKDTree(positions(found)).query(places[inside])
    seen = np.where(away < BUDGET_PX, found["kind"].to_numpy().astype(str)[which], "missed")
    fitted = positions(found)[np.isfinite(found["fit_ref"][:, 0].to_numpy())]
    false = int((cKDTree(places).query(fitted)[0] > 2 * BUDGET_PX).sum())
    return {kind: sorted(set(seen[kinds[inside] == kind])) for kind in np.unique(kinds)}, false


@pytest.mark.parametrize(
    ("amplitudes", "contrast", "expected"),
    [
        ({"A": 1.0, "B": 0.6}, 0.6, {"A": ["A"], "B": ["B"]}),
        ({"A": 1.0, "B": 0.2}, 0.6, {"A": ["A"], "B": ["B"]}),
        ({"A": 1.0, "B": 0.5, "O": 0.25}, 0.6, {"A": ["A"], "B": ["B"], "O": ["C"]}),
        ({"A": 1.0, "B": 0.6, "O": 0.35}, -0.4, {"A": ["A"], "B": ["B"], "O": ["C"]}),
        ({"A": 1.0, "B": 1.0}, 0.6, {"A": [""], "B": [""]}),
    ],
)
def test_all_columns_of_a_perovskite_are_found_with_their_kinds(amplitudes, contrast, expected):
    image, places, kinds = summed(amplitudes, contrast=contrast)
    found = find_columns(image)
    assert found.attrs["contrast"] == ("bright" if contrast > 0 else "dark")
    assert judged(found, places, kinds) == (expected, 0)
    assert found.attrs["left_out"] == []


def test_what_is_left_out_is_told_with_its_reason():
    image, *_ = summed({"A": 1.0, "B": 0.1}, dose=200.0)
    (faint,) = find_columns(image).attrs["left_out"]
    assert (faint["why"], faint["number"] > 15) == ("faint", True)
    assert faint["share"] == pytest.approx(0.1, abs=0.03)
    assert faint["cell"] == pytest.approx([0.5, 0.5], abs=0.03)
    kept = find_columns(image, ColumnSettings(min_amplitude=0.05))
    assert set(kept["kind"].to_numpy().astype(str)) == {"A", "B"}


def test_kinds_do_not_follow_slow_changes_nor_single_columns():
    """A wedge of a factor of two, a scatter of 5 %, three vacancies, a bright impurity, a column off the lattice."""
    rng = np.random.default_rng(3)
    i, j = np.mgrid[:12, :10].reshape(2, -1)
    kinds = np.where((i + j) % 2, "A", "B")
    amplitude = np.where(kinds == "A", 1.0, 0.7) * (1 + i / 12) * rng.normal(1, 0.05, len(i))
    amplitude[37] *= 2.5
    places = np.stack([i, j], axis=1) * 12.0 + rng.normal(0, 0.4, (len(i), 2))
    there = np.setdiff1d(np.arange(len(i)), [20, 21, 77])
    places = np.append(places[there], [[-20.0, 57.0]], axis=0)
    found = kinds_of(places, np.append(amplitude[there], 0.2), Lattice((12.0, 0.0), (0.0, 12.0)))
    np.testing.assert_array_equal(found[:-1], kinds[there])
    assert found[-1] == ""


def test_places_that_are_equally_bright_are_one_kind_and_given_kinds_stay():
    i, j = np.mgrid[:6, :6].reshape(2, -1)
    first = np.stack([i, j], axis=1) * [30.0, 40.0]
    pairs = np.concatenate([first, first + np.array([9.0, 0.0])])
    lattice = Lattice((30.0, 0.0), (0.0, 40.0))
    assert set(kinds_of(pairs, np.ones(72), lattice)) == {""}
    brighter = kinds_of(pairs, np.repeat([1.0, 0.8], 36), lattice)
    assert [set(part) for part in np.split(brighter, 2)] == [{"A"}, {"B"}]
    assert set(kinds_of(pairs, np.ones(72), None)) == {""}
