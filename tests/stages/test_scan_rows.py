"""Displaced rows of scanned movies, from the pixels to the tracks."""

import functools
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from conftest import Scene

from tract_dask import convert, fit_columns, open_movie, open_results
from tract_dask.analysis.motion import places_in_frames
from tract_dask.errors import SettingsError
from tract_dask.export.tables import table
from tract_dask.report.crystal import row_words
from tract_dask.settings import ConvertSettings, FitSettings, MetadataSettings
from tract_dask.stages.fit.job import prepare
from tract_dask.stages.fit.row_homes import on_sites, sites_of
from tract_dask.stages.fit.scan_rows import absorbed_variance
from tract_dask.stages.fit.stage import fit_movie

JITTER_PX = 1.3


class Scanned(Scene):
    """8 x 8 columns; each row of a frame is displaced along x by ``offsets`` (frames, rows), px."""

    def __init__(self, n_frames=3):
        super().__init__(n_frames=n_frames, shape=(288, 260), amplitude=80.0)
        self.offsets = np.random.default_rng(4).normal(0, JITTER_PX, (n_frames, self.shape[0]))

    def counts(self, present=None, dtype="uint16"):
        rng, frames = np.random.default_rng(5), []
        for offsets, shift in zip(self.offsets, self.drift, strict=True):
            image = np.full(self.shape, self.background)
            for x0, y0 in self.place + shift[::-1]:
                y, x = np.mgrid[int(y0) - 18 : int(y0) + 19, int(x0) - 18 : int(x0) + 19]
                dx, dy = x - x0 - offsets[y[:, :1]], y - y0
                along, across = dx * np.cos(0.4) - dy * np.sin(0.4), dx * np.sin(0.4) + dy * np.cos(0.4)
                image[y, x] += self.amplitude * np.exp(-0.5 * (along / 4) ** 2 - 0.5 * (across / 3) ** 2)
            frames.append(rng.poisson(image))
        return np.array(frames).astype(dtype)


@pytest.fixture(scope="module")
def scanned(tmp_path_factory):
    folder, scene = tmp_path_factory.mktemp("scan"), Scanned()
    np.save(folder / "movie.npy", scene.counts())
    settings, metadata = ConvertSettings(tile_px=64), MetadataSettings(pixel_size_pm=10.0)
    return scene, open_movie(convert(folder / "movie.npy", folder / "movie.zarr", settings=settings, metadata=metadata))


@pytest.fixture(scope="module")
def fitted(scanned):
    """What fits the movie with some settings, once."""
    scene, movie = scanned

    @functools.cache
    def fit(**settings):
        lazy = fit_columns(movie, scene.columns(), scene.drift_dataset(), FitSettings(refine_drift=False, **settings))
        return lazy.compute(scheduler="synchronous")

    return fit


def off(tracks, scene, axis="x"):
    """Return how far tracks are from where the columns are, less what all of a frame share."""
    away = tracks["fit"].sel(parameter=axis).to_numpy() - scene.place[:, int(axis == "y")]
    return away - away.mean(axis=1, keepdims=True)


@pytest.mark.parametrize("estimator", ["lsq", "poisson"])
def test_positions_are_freed_from_rows(scanned, fitted, estimator):
    scene, usual = scanned[0], fitted(estimator=estimator)
    freed = fitted(estimator=estimator, scan_rows="sum")
    assert "row_shift" not in usual
    assert off(freed, scene).std() < 0.4 * off(usual, scene).std()
    assert (off(freed, scene) / freed["stderr"].sel(parameter="x")).std() == pytest.approx(1, abs=0.2)
    np.testing.assert_allclose(freed["fit"].sel(parameter="x") + freed["row_shift"], usual["fit"].sel(parameter="x"))
    np.testing.assert_array_equal(off(freed, scene, "y"), off(usual, scene, "y"))
    np.testing.assert_allclose(places_in_frames(freed), places_in_frames(usual), atol=1e-9)


def test_offsets_of_rows_are_found(scanned, fitted):
    """But for what all rows of a frame share, which cannot be told from its drift."""
    scene, freed = scanned[0], fitted(scan_rows="sum")
    error = freed["row_offset"].to_numpy() - scene.offsets
    stated = freed["row_offset_stderr"].to_numpy()
    told = stated < 0.5 * JITTER_PX
    error -= np.average(error, axis=1, weights=told / stated**2)[:, None]
    assert told.mean() > 0.3
    assert error[told].std() < 0.4 * JITTER_PX
    assert (error / stated)[told].std() == pytest.approx(1, abs=0.2)


def test_a_report_says_how_far_rows_were_displaced(fitted):
    def told(**settings):
        run = SimpleNamespace(fit=FitSettings(**settings))
        return row_words(SimpleNamespace(tracks=fitted(**settings).chunk(), settings=run))

    summed, lattice = told(scan_rows="sum"), told(scan_rows="lattice")
    assert "displaced along x by 1" in summed["text"]
    assert summed["serious"]
    assert "--scan-rows lattice" in summed["remedy"]
    assert not lattice["serious"]
    assert "share with their row" in lattice["text"]
    assert not lattice["remedy"]
    assert told() is None


def test_tables_have_no_rows_of_rows(fitted):
    tracks = fitted(scan_rows="sum")
    rows = table(tracks)
    assert len(rows) == tracks["status"].size
    np.testing.assert_array_equal(rows["row_shift"], tracks["row_shift"].to_numpy().ravel())


def test_a_lattice_says_where_columns_belong(scanned, fitted):
    scene, usual = scanned[0], fitted()
    freed = fitted(scan_rows="lattice")
    assert off(freed, scene).std() < 0.6 * off(usual, scene).std()


def test_results_on_disk_are_those_of_fit_columns(scanned, fitted, tmp_path):
    scene, movie = scanned
    settings = FitSettings(refine_drift=False, scan_rows="sum")
    fit_movie(movie, prepare(movie, scene.columns(), scene.drift_dataset(), settings), tmp_path / "results.zarr")
    stored, lazy = open_results(tmp_path / "results.zarr").load(), fitted(scan_rows="sum")
    assert stored["row_offset"].dims == ("frame", "row")
    for name in ("fit", "row_offset", "row_offset_stderr", "row_shift"):
        xr.testing.assert_equal(
            stored[name].drop_vars("unit", errors="ignore"), lazy[name].drop_vars("unit", errors="ignore")
        )


def test_sublattices_without_a_kind_are_told_by_their_place_in_the_cell():
    """Dumbbells: sites of both atoms, though no kind is known."""
    i, j = np.meshgrid(np.arange(8), np.arange(8))
    cell = np.stack([i.ravel() * 30 + j.ravel() * 6.0, j.ravel() * 26.0], axis=1)
    places = np.concatenate([cell, cell + np.array([11.0, 4.0])])
    design = sites_of(places[:, ::-1], np.full(len(places), "", dtype=object))
    assert np.isfinite(design).all()
    np.testing.assert_allclose(on_sites(places[:, 0], design), places[:, 0], atol=1e-9)


@pytest.mark.parametrize(
    ("settings", "words"), [({"scan_rows": "sum"}, "sum of so few frames"), ({"scan_rows": "lattice"}, "no lattice")]
)
def test_columns_that_cannot_say_where_they_belong_are_refused(tmp_path, settings, words):
    scene = Scene(n_frames=1)
    np.save(tmp_path / "movie.npy", scene.counts())
    movie = open_movie(convert(tmp_path / "movie.npy", tmp_path / "movie.zarr"))
    columns = scene.columns().isel(column_id=[0, 1, 2])
    with pytest.raises(SettingsError, match=words):
        prepare(movie, columns, None, FitSettings(**settings))


def test_a_filter_of_whole_frames_is_refused():
    with pytest.raises(SettingsError, match="offsets of rows"):
        FitSettings(scan_rows="sum", filter="wiener")


def test_free_widths_are_refused():
    with pytest.raises(SettingsError, match="known widths"):
        FitSettings(scan_rows="sum", shape="free")


def test_what_a_lattice_takes_of_offsets_is_in_their_errors():
    """A line through offsets of rows is what moves and shears the lattice: its variance is that of made ones."""
    rng, y = np.random.default_rng(7), np.arange(200.0)
    made = rng.normal(0, 2.0, (400, 200))
    lines = np.array([np.polyval(np.polyfit(y, offsets, 1), y) for offsets in made])
    stated = np.mean([absorbed_variance(offsets) for offsets in made], axis=0)
    np.testing.assert_allclose(stated, lines.var(axis=0), rtol=0.3)
