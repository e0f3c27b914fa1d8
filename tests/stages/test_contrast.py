"""Bright or dark: what the summed image says, whatever stands beside the columns."""

import numpy as np
import pytest
import xarray as xr
from scipy.spatial import cKDTree

from tract_dask import detect_columns, find_columns
from tract_dask.settings import ColumnSettings
from tract_dask.stages.columns.contrast import CLOSE, chosen
from tract_dask.store.columns import column_dataset, positions

SHAPE, SPACING, SIGMA, BACKGROUND, FRAMES = (260, 300), 26.0, 3.4, 20.0, 40
TOP = 90
"""Above is vacuum."""


def places(top=TOP):
    rows = np.arange(top + 14.0, SHAPE[0], SPACING * np.sqrt(3) / 2)
    return np.array([(x, y) for k, y in enumerate(rows) for x in np.arange(13.0 + k % 2 * 13, SHAPE[1], SPACING)])


def summed(amplitude, vacuum=1.0, top=TOP, slope=0.0, seed=0):
    """Columns of this height, against the background, below a vacuum of this level; Poisson counts of 40 frames."""
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    image = np.where(y < top + 0.03 * x - 4, vacuum, 1.0) * BACKGROUND * (1 + slope * x / SHAPE[1])
    for at_x, at_y in places(top):
        image += amplitude * BACKGROUND * np.exp(-((x - at_x) ** 2 + (y - at_y) ** 2) / (2 * SIGMA**2))
    image = np.random.default_rng(seed).poisson(image * FRAMES) / FRAMES
    return xr.Dataset({"image": (("y", "x"), image), "exposure": (("y", "x"), np.full(image.shape, FRAMES, np.uint32))})


def judged(found, top=TOP):
    """Return the share of the true columns, away from the edges, that were found, and the number of false ones."""
    truth, limits = places(top), np.array(SHAPE[::-1])
    inner = truth[((truth > 20) & (truth < limits - 20)).all(axis=1)]
    near = cKDTree(positions(found)).query(inner)[0] < SPACING / 5
    return near.mean(), int((cKDTree(truth).query(positions(found))[0] > SPACING / 5).sum())


@pytest.mark.parametrize("contrast", ["bright", "dark"])
@pytest.mark.parametrize("height", [0.15, 0.45, 0.9])
def test_the_contrast_is_found_and_named(contrast, height):
    found = find_columns(summed(height if contrast == "bright" else -height))
    assert found.attrs["contrast"] == contrast
    assert found.attrs["contrast_rival"] < CLOSE / 5
    assert judged(found) == (1.0, 0)


@pytest.mark.parametrize("vacuum", [0.1, 0.3, 1.6, 3.0])
@pytest.mark.parametrize("contrast", ["bright", "dark"])
def test_the_rim_of_the_specimen_does_not_decide(contrast, vacuum):
    """A step of up to seven times a column's height: no contrast, lattice or column is taken from it, and none lost."""
    found = find_columns(summed(0.3 if contrast == "bright" else -0.3, vacuum))
    assert found.attrs["contrast"] == contrast
    assert found.attrs["lattice_px"] == pytest.approx(SPACING, rel=0.02)
    assert found.attrs["contrast_rival"] < CLOSE
    assert judged(found) == (1.0, 0)


@pytest.mark.parametrize("vacuum", [1.2, 1.5])
def test_a_rim_lower_than_columns_is_no_column(vacuum):
    assert judged(find_columns(summed(0.9, vacuum))) == (1.0, 0)


def test_a_wedge_does_not_decide():
    assert find_columns(summed(-0.3, slope=2.0)).attrs["contrast"] == "dark"


def test_a_contrast_that_is_set_stays():
    image = summed(0.45)
    found = find_columns(image, ColumnSettings(contrast="bright"))
    assert found.attrs["contrast"] == "bright"
    assert found.attrs["contrast_rival"] is None
    np.testing.assert_allclose(positions(found), positions(find_columns(image)))


@pytest.mark.parametrize("sign", [1, -1])
def test_columns_that_are_given_have_their_contrast(sign):
    inner = places()[places()[:, 1] < SHAPE[0] - 20]
    found = find_columns(summed(sign * 0.45), seeds=column_dataset(inner))
    assert (np.sign(found["fit_ref"].sel(parameter="amplitude").to_numpy()[found["status_ref"] == 0]) == sign).all()


@pytest.mark.parametrize("sign", [1, -1])
def test_detectors_find_the_contrast(sign):
    found = detect_columns(summed(sign * 0.45), settings=ColumnSettings(min_amplitude=0.5))
    away = cKDTree(places()).query(np.stack([found["x"], found["y"]], axis=1))[0]
    assert (away < 2).mean() > 0.98


def test_of_two_that_are_alike_the_first_is_taken():
    assert chosen({"bright": 0.0, "dark": 0.0}) == ("bright", 1.0)
