"""Zarr stores as movies: whoever wrote them, however they are cut into chunks."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numcodecs
import numpy as np
import pytest
import xarray as xr
import zarr
from files_hdf5 import FRAMES, array, ome, zipped, zspy
from test_reader_fuzz import mutated

from tract_dask.errors import InputError, SourceError, TractError
from tract_dask.readers import FrameSource, is_movie_folder, open_source
from tract_dask.settings import MetadataSettings
from tract_dask.stages.convert.stage import convert
from tract_dask.store.movie import open_movie

YX = [{"name": "y", "type": "space", "unit": "nanometer"}, {"name": "x", "type": "space", "unit": "nanometer"}]
TYX = [{"name": "t", "type": "time", "unit": "millisecond"}, *YX]
FIVE = [{"name": "t", "type": "time", "unit": "second"}, {"name": "c"}, {"name": "z"}, *YX]
AXES = [("time", "s", 0.5, True), ("y", "nm", 0.02, False), ("x", "nm", 0.02, False)]


def same(source: FrameSource, frames: np.ndarray = FRAMES) -> None:
    for found in (source, pickle.loads(pickle.dumps(source))):
        np.testing.assert_array_equal(found.read(0, len(frames)), frames)
        np.testing.assert_array_equal(found.read(1, 4), frames[1:4])
        into = np.empty((2, *frames.shape[1:]), frames.dtype)
        found.read_into(2, into)
        np.testing.assert_array_equal(into, frames[2:4])


def named(path: Path, version: int) -> None:
    """An array with named dimensions, turned, and coordinates of them, as xarray writes it."""
    root = zarr.open_group(str(path), mode="w", zarr_format=version)
    turned = FRAMES.transpose(1, 2, 0)
    said: Any = {"dimension_names": ("y", "x", "time")} if version == 3 else {}
    found = array(root.store, "movie", turned, (20, 36, 2), zarr_format=version, **said)
    if version == 2:
        found.attrs["_ARRAY_DIMENSIONS"] = ["y", "x", "time"]
    for name, values, unit in (("y", 0.02, "nm"), ("x", 0.02, "nm"), ("time", 0.5, "s")):
        length = dict(zip(("y", "x", "time"), turned.shape, strict=True))[name]
        made = array(root.store, name, np.arange(length) * values, (length,), zarr_format=version)
        made.attrs["units"] = unit


def plain(path: Path, **options: Any) -> None:
    array(str(path), "", FRAMES, **options)


BLOSC = numcodecs.Blosc("lz4")
WRITERS: dict[str, tuple[Callable[[Path], object], float | None, float | None]] = {
    "plain 2": (lambda path: plain(path, chunks=(2, 16, 20), zarr_format=2), None, None),
    "plain 2 in folders": (
        lambda path: plain(path, zarr_format=2, chunk_key_encoding={"name": "v2", "separator": "/"}, filters=None),
        None,
        None,
    ),
    "plain 2 blosc": (lambda path: plain(path, zarr_format=2, order="F", compressors=BLOSC), None, None),
    "plain 3": (lambda path: plain(path, chunks=(5, 40, 36)), None, None),
    "plain 3 with dots": (
        lambda path: plain(path, chunk_key_encoding={"name": "default", "separator": "."}),
        None,
        None,
    ),
    "sharded": (lambda path: plain(path, chunks=(1, 20, 18), shards=(2, 40, 36)), None, None),
    "named 2": (lambda path: named(path, 2), 20.0, 0.5),
    "named 3": (lambda path: named(path, 3), 20.0, 0.5),
    "OME 0.5": (lambda path: ome(path, FRAMES, TYX, [40, 0.02, 0.02]), 20.0, 0.04),
    "OME 0.4": (lambda path: ome(path, FRAMES[:, None, None], FIVE, [2, 1, 1, 0.02, 0.02], 2), 20.0, 2.0),
    "OME 0.3": (lambda path: ome(path, FRAMES, ["t", "y", "x"], [1, 1, 1], 2), None, None),
    "OME 0.2": (lambda path: ome(path, FRAMES[:, None, None], None, [1] * 5, 2), None, None),
    "zspy": (lambda path: zspy(path, FRAMES, AXES), 20.0, 0.5),
}


@pytest.mark.parametrize("name", WRITERS)
def test_stores_of_others(name: str, tmp_path: Path) -> None:
    write, pixel, seconds = WRITERS[name]
    path = tmp_path / "a.zarr"
    write(path)
    asked: list[Path] = []
    source = open_source(path, permit=asked.append)
    same(source)
    assert (source.metadata.pixel_size_pm, source.metadata.frame_time_s) == (pixel, seconds)
    assert [note for note in source.metadata.notes if "length 1 are passed over" not in note] == []
    assert is_movie_folder(path)
    assert all({file, *file.parents} & set(asked) for file in map(Path.resolve, source.files))
    chunks = [file for file in source.files if file.name[:1] not in ".z"]
    for k in range(5):
        part = source.files[source.files_of(k, k + 1)]
        assert part
        assert set(part) <= set(chunks)
    assert {file for k in range(5) for file in source.files[source.files_of(k, k + 1)]} == set(chunks)
    packed = zipped(path, tmp_path / "b.zarr")
    same(open_source(packed))
    assert open_source(packed).files == (packed,)


def test_paths_inside(tmp_path: Path) -> None:
    path = ome(tmp_path / "a.zarr", FRAMES, TYX, [40, 0.02, 0.02])
    for name in (f"{path}::/0", f"{path}/0", f"{path}::0/"):
        same(open_source(name))
    assert open_source(f"{path}::/0").metadata.pixel_size_pm == 20
    assert open_source(f"{path}::/1").shape == (5, 20, 18)
    array(str(path), "other", FRAMES + 1)
    same(open_source(path))
    same(open_source(f"{path}::/other"), FRAMES + 1)
    for name, words in (("/none", "nothing under this path"), ("../a.zarr", "lead out")):
        with pytest.raises(SourceError, match=words):
            open_source(f"{path}::{name}")


def test_several_arrays_are_listed(tmp_path: Path) -> None:
    for name in ("one", "two/deep"):
        array(str(tmp_path / "a.zarr"), name, FRAMES)
    with pytest.raises(SourceError, match=r"2 data sets.*/one \(5, 40, 36\) uint16, /two/deep.*a.zarr::/one"):
        open_source(tmp_path / "a.zarr")


@pytest.mark.parametrize(
    ("shape", "axes", "words"),
    [
        ((3, 2, 1, 40, 36), FIVE, "several channels"),
        ((3, 40, 36), [{"name": "detector", "type": "channel"}, *YX], "several channels"),
        ((3, 1, 2, 40, 36), FIVE, r"4 axes.*axes t \(second\), z"),
        ((4, 40, 36), [{"name": "energy", "unit": "eV"}, *YX], "spectrum"),
    ],
)
def test_what_is_no_movie_is_refused_by_name(
    shape: tuple[int, ...], axes: list[Any], words: str, tmp_path: Path
) -> None:
    ome(tmp_path / "a.zarr", np.zeros(shape, "u1") + 1, axes, [1.0] * len(shape))
    with pytest.raises(SourceError, match=words):
        open_source(tmp_path / "a.zarr")
    zspy(tmp_path / "b.zspy", FRAMES, [("y", "", 1, True), ("x", "", 1, True), ("", "", 1, False)])
    with pytest.raises(SourceError, match="spectrum"):
        open_source(tmp_path / "b.zspy")


@pytest.mark.parametrize("version", [2, 3])
def test_chunks_that_are_missing(version: int, tmp_path: Path) -> None:
    path = tmp_path / "a.zarr"
    plain(path, zarr_format=version, fill_value=7)
    last, before = (path / ("c/4/0/0" if version == 3 else "4.0.0")), (path / ("c/3/0/0" if version == 3 else "3.0.0"))
    whole = open_source(path)
    last.unlink()
    with pytest.raises(SourceError, match="no such file"):
        whole.read(4, 5)
    np.testing.assert_array_equal(whole.read(0, 4), FRAMES[:4])
    found = open_source(path)
    assert "1 of 5 chunks are not there; they are read as 7" in found.metadata.notes[0]
    assert (found.read(4, 5) == 7).all()
    before.write_bytes(b"")
    with pytest.raises(SourceError, match="ends before it begins"):
        open_source(path)
    for k in range(4):
        (path / (f"c/{k}/0/0" if version == 3 else f"{k}.0.0")).unlink()
    with pytest.raises(SourceError, match="no chunk of the array is there"):
        open_source(path)


@pytest.mark.parametrize("location", ["start", "end"])
def test_chunks_that_are_missing_inside_shards(location: str, tmp_path: Path) -> None:
    frames = np.where(np.arange(5)[:, None, None] < 3, FRAMES + 1, 0)
    codecs = zarr.codecs.ShardingCodec(chunk_shape=(1, 20, 16), index_location=location)
    found = zarr.create(frames.shape, store=str(tmp_path / "a.zarr"), dtype="u2", chunks=(4, 40, 48), codecs=[codecs])
    found[:4] = frames[:4]
    found[4, 39, 35] = 1
    source = open_source(tmp_path / "a.zarr")
    assert "11 of 30 chunks are missing in its shards; they are read as 0" in source.metadata.notes[0]
    np.testing.assert_array_equal(source.read(0, 4), frames[:4])


@pytest.mark.parametrize("shards", [None, (2, 40, 36)])
def test_damaged_heads_of_blosc_do_not_end_the_process(shards: Any, tmp_path: Path) -> None:
    plain(tmp_path / "a.zarr", shards=shards, compressors=zarr.codecs.BloscCodec(cname="lz4"))
    source = open_source(tmp_path / "a.zarr")
    same(source)
    path = source.files[source.files_of(0, 1)][0]
    whole = path.read_bytes()
    for at, said in ((12, 185140684), (12, 20), (4, 0x7FFFFFFF)):
        path.write_bytes(whole[:at] + said.to_bytes(4, "little") + whole[at + 4 :])
        with pytest.raises(SourceError, match="its head says other lengths"):
            source.read(0, 1)


def test_a_change_between_opening_and_reading(tmp_path: Path) -> None:
    path = tmp_path / "a.zarr"
    plain(path)
    source = open_source(path)
    zarr.open_array(str(path), mode="r+").resize((3, 40, 36))
    with pytest.raises(SourceError, match="has changed"):
        source.read(0, 2)


def test_links_that_are_not_permitted(tmp_path: Path) -> None:
    class RefusedError(InputError):
        pass

    def permit(path: Path) -> None:
        if not path.is_relative_to(tmp_path.resolve() / "root"):
            raise RefusedError("outside", str(path))

    (tmp_path / "root").mkdir()
    plain(tmp_path / "root/a.zarr")
    np.testing.assert_array_equal(open_source(tmp_path / "root/a.zarr", permit=permit).read(0, 5), FRAMES)
    for name in ("c/2/0/0", "c/3", "zarr.json"):
        place = tmp_path / "root/a.zarr" / name
        away = place.rename(tmp_path / "away")
        place.symlink_to(away)
        with pytest.raises(RefusedError):
            open_source(tmp_path / "root/a.zarr", permit=permit)
        same(open_source(tmp_path / "root/a.zarr"))
        place.unlink()
        away.rename(place)


def test_codecs_that_would_run_code(tmp_path: Path) -> None:
    path = tmp_path / "a.zarr"
    plain(path, zarr_format=2)
    about = json.loads((path / ".zarray").read_text())
    (path / ".zarray").write_text(json.dumps(about | {"filters": [{"id": "pickle", "protocol": 5}]}))
    with pytest.raises(SourceError, match="runs whatever is in the file"):
        open_source(path)


def test_our_own_movie_is_a_source(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", FRAMES)
    known = MetadataSettings(pixel_size_pm=20.0, frame_time_s=0.5, dose=3.0, gain=2.0)
    movie = convert(tmp_path / "a.npy", tmp_path / "movie.zarr", metadata=known)
    source = open_source(movie)
    same(source)
    found = source.metadata
    assert (found.pixel_size_pm, found.frame_time_s, found.dose) == (20.0, 0.5, 3.0)
    assert found.gain == 2.0
    assert "gain of 2, which is used" in found.notes[0]
    again = open_movie(convert(source, tmp_path / "again.zarr"))
    np.testing.assert_array_equal(again.read(0, 5), FRAMES)
    assert (again.pixel_size_pm, again.frame_time_s, again.dose) == (20.0, 0.5, 3.0)


def test_a_changed_chunk_is_another_movie(tmp_path: Path) -> None:
    path = tmp_path / "a.zarr"
    plain(path)
    convert(path, tmp_path / "movie.zarr")
    zarr.open_array(str(path), mode="r+")[3] = 9
    with pytest.raises(TractError, match="made from something else"):
        convert(path, tmp_path / "movie.zarr")


@pytest.mark.parametrize("version", [2, 3])
def test_mutated_stores_give_frames_or_one_of_our_errors(version: int, tmp_path: Path) -> None:
    path = ome(tmp_path / "a.zarr", FRAMES, TYX, [40, 0.02, 0.02], version)
    files = [file for file in sorted(path.rglob("*")) if file.is_file() and "1" not in file.relative_to(path).parts[0]]
    opened = 0
    for seed in range(60):
        file = files[seed % len(files)]
        whole = file.read_bytes()
        file.write_bytes(mutated(whole, seed))
        try:
            source = open_source(path)
            source.read(0, 1)
            source.read(source.shape[0] - 1, source.shape[0])
            opened += 1
        except TractError as error:
            assert "a.zarr" in str(error)  # noqa: PT017 - most of them open
        file.write_bytes(whole)
    assert opened >= 10


def test_times_since_a_moment_as_xarray_writes_them(tmp_path: Path) -> None:
    moments = np.datetime64("2026-01-01") + np.array([0, 40, 80, 200, 240]) * np.timedelta64(1, "ms")
    xr.Dataset({"movie": (("time", "y", "x"), FRAMES)}, {"time": moments}).to_zarr(tmp_path / "a.zarr", zarr_format=2)
    known = open_source(tmp_path / "a.zarr").metadata
    assert known.frame_time_s == 0.04
    np.testing.assert_allclose(known.along_frames["time"].values, [0, 0.04, 0.08, 0.2, 0.24])
