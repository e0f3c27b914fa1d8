"""Runs on a part of a movie: the same numbers as from that part alone, at places and frames of the movie on disk."""

from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from conftest import Scene

from tract_dask.errors import SettingsError
from tract_dask.export.tables import table
from tract_dask.readers import open_source
from tract_dask.readers.source import Part
from tract_dask.run.pipeline import run
from tract_dask.settings import ConvertSettings, MetadataSettings, RunSettings, SourceSettings
from tract_dask.stages.convert.stage import convert
from tract_dask.store import schema
from tract_dask.store.columns import check_inside, column_dataset
from tract_dask.store.movie import open_movie
from tract_dask.store.results import accepted, open_results
from tract_dask.store.source_pixels import in_source_pixels

LAYOUT = ConvertSettings(shard_mb=1)
KNOWN = MetadataSettings(pixel_size_pm=8.0, frame_time_s=0.5)
TOP, LEFT = 7, 12


@pytest.fixture(scope="module")
def counts() -> np.ndarray:
    return Scene().counts()


def tracks_of(frames: np.ndarray, folder: Path, client: object, declared: SourceSettings) -> xr.Dataset:
    folder.mkdir()
    np.save(folder / "movie.npy", frames)
    settings = RunSettings(source=declared, metadata=KNOWN, convert=LAYOUT)
    run(folder / "movie.npy", folder / "out", settings, client=client, report=False)
    return open_results(folder / "out" / "results.zarr").load()


def test_frames_and_a_field_give_the_bits_of_that_part_alone(counts, tmp_path, client):
    n_frames, n_y, n_x = counts.shape
    whole = np.random.default_rng(0).poisson(30, (2 * n_frames + 3, n_y + 20, n_x + 30)).astype(counts.dtype)
    whole[3::2, TOP : TOP + n_y, LEFT : LEFT + n_x] = counts
    declared = SourceSettings(frames="3::2", roi=f"{TOP}:{TOP + n_y},{LEFT}:{LEFT + n_x}")
    part = tracks_of(whole, tmp_path / "part", client, declared)
    alone = tracks_of(counts, tmp_path / "alone", client, SourceSettings())
    for name in alone.data_vars:
        if name != "time":
            own = part[name].drop_vars(schema.SOURCE, errors="ignore").drop_attrs()
            xr.testing.assert_identical(own, alone[name].drop_attrs())
    np.testing.assert_array_equal(part["time"], 2 * alone["time"])
    on_disk, own = table(in_source_pixels(part)), table(alone)
    np.testing.assert_array_equal(on_disk["frame"], 3 + 2 * own["frame"])
    for name, shift in (("x", LEFT), ("y", TOP), ("centroid_y", TOP), ("x_stderr", 0), ("sigma_a", 0)):
        np.testing.assert_allclose(on_disk[name], own[name] + shift, rtol=0, atol=1e-9)


def test_places_in_a_binned_movie_are_those_on_disk(counts, tmp_path, client):
    scene = Scene()
    part = tracks_of(counts, tmp_path / "part", client, SourceSettings(bin=2))
    assert part.attrs["pixel_size_pm"] == 16.0
    on_disk = in_source_pixels(part)
    assert on_disk.attrs["pixel_size_pm"] == 8.0
    found = accepted(on_disk)["fit"].sel(parameter=["x", "y"]).mean("frame").to_numpy()
    distance = np.linalg.norm(found[:, None] - scene.place, axis=2).min(axis=1)
    assert len(found) == len(scene.place)
    assert distance.max() < 0.15  # px on disk; a fit of a frame has about 0.2
    assert in_source_pixels(on_disk) is on_disk
    np.testing.assert_allclose(part["x_source_px"], on_disk["x_ref"])
    np.testing.assert_allclose(part["y_source_px"], on_disk["y_ref"])
    np.testing.assert_array_equal(part["source_frame"], on_disk["frame"])
    assert {"x_source_px", "y_source_px", "source_frame"}.isdisjoint(on_disk.coords)


def test_a_part_of_a_converted_part_is_one_of_the_movie_on_disk(tmp_path):
    """Frames, field, bins and gain of a movie.zarr that is the source of the next run are those of its own source."""
    frames = np.random.default_rng(0).integers(0, 99, (12, 40, 48)).astype("u2")
    np.save(tmp_path / "movie.npy", frames)
    first = SourceSettings(frames="2:12:2", roi="4:36,8:40", bin=2)
    convert(tmp_path / "movie.npy", tmp_path / "a.zarr", source_settings=first, metadata=MetadataSettings(gain=2.5))
    whole = open_source(tmp_path / "a.zarr")
    assert whole.metadata.part == Part(2, 2, 4, 8, 2)
    assert whole.metadata.gain == 2.5
    assert open_source(tmp_path / "a.zarr", metadata=MetadataSettings(gain=3.0)).metadata.gain == 3.0
    convert(tmp_path / "a.zarr", tmp_path / "b.zarr", source_settings=SourceSettings(frames="1:5:3", roi="2:14,6:16"))
    movie = open_movie(tmp_path / "b.zarr")
    assert movie.part == asdict(Part(4, 6, 8, 20, 2))
    assert movie.gain == 2.5
    cut = frames[4::6, 8:32, 20:40].reshape(2, 12, 2, 10, 2).sum((2, 4))
    np.testing.assert_array_equal(movie.read(0, 2), cut)


@pytest.mark.parametrize(("x", "y", "words"), [(90.0, 10.0, "not those of the whole movie"), (20.0, 45.0, "exchanged")])
def test_columns_outside_a_part_name_the_likely_mistake(x, y, words):
    with pytest.raises(SettingsError, match=words):
        check_inside(column_dataset(np.array([[x, y]])), (40, 48), "columns.csv")
