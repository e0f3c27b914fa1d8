"""Files of a finished run, damaged one by one: each reader raises an error of ours, or gives the same numbers."""

import errno
import json
import os
import shutil
import zlib
from contextlib import contextmanager
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
import zarr
from click.testing import CliRunner
from conftest import Scene
from distributed import Client, LocalCluster

from tract_dask import convert
from tract_dask.cli.main import main
from tract_dask.errors import DestinationError, MissingStoreError, StoreError
from tract_dask.progress import StageDone
from tract_dask.report.page import write_report
from tract_dask.run import one_stage, pipeline
from tract_dask.run.verify import verify
from tract_dask.settings import ConvertSettings, RunSettings
from tract_dask.store import damage as damages
from tract_dask.store import datasets
from tract_dask.store import files as store_files
from tract_dask.store import metadata as store_metadata
from tract_dask.store.damage import store_of
from tract_dask.store.journal import Journal, journal_beside
from tract_dask.store.movie import open_movie
from tract_dask.store.parts import SHARDED, write
from tract_dask.store.results import calibrate, open_results
from tract_dask.store.shards import split

SETTINGS = RunSettings(convert=ConvertSettings(shard_mb=1, tile_px=64))
STORES = ("movie", "drift", "sum", "columns", "results")


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A finished run's folder, with the movie beside it; each test leaves it as it was."""
    folder = tmp_path_factory.mktemp("run")
    np.save(folder / "movie.npy", Scene().counts())
    with (
        LocalCluster(processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None) as local,
        Client(local) as client,
    ):
        pipeline.run(folder / "movie.npy", folder / "out", SETTINGS, client=client, report=False)
    return folder / "out"


def numbers(dataset: xr.Dataset) -> bytes:
    """Everything that a Dataset says."""
    told = [repr(sorted(dataset.attrs.items()))]
    for name in sorted(map(str, dataset.variables)):
        values = dataset[name].to_numpy()
        told += [name, repr(dataset[name].attrs), str(values.dtype), str(values.shape)]
        told.append(repr(values.tolist()) if values.dtype.kind in "OT" else values.tobytes().hex())
    return "\n".join(told).encode()


def read_movie(store: Path) -> bytes:
    movie = open_movie(store)
    parts = [movie.read(0, movie.n_frames), *(movie.read_binned(factor, 0, movie.n_frames) for factor in movie.bins)]
    tiles = [pixels.tobytes() for shard in movie.shards for *_, pixels in movie.tiles(shard)]
    coordinates = [movie.frames[axis].to_numpy().tobytes() for axis in "tyx"]
    about = repr((movie.shape, movie.dtype, movie.key, movie.bins, movie.pixel_size_pm, movie.gain)).encode()
    return b"".join([*(part.tobytes() for part in parts), *tiles, *coordinates, numbers(movie.statistics()), about])


def read_results(store: Path) -> bytes:
    tracks = open_results(store).compute(scheduler="synchronous")
    alone = [np.asarray(datasets.open_array(store / name)[:]).tobytes() for name in ("fit", "status", "presence")]
    return b"".join([numbers(tracks), *alone, repr(store_metadata.attributes(store)).encode()])


def read(store: Path) -> bytes:
    """All that a store says, by the ways in which this package reads it."""
    readers = {"movie": read_movie, "results": read_results}
    return readers.get(store.stem, lambda path: numbers(datasets.open_dataset(path)))(store)


def flip(data: bytearray, rng: np.random.Generator) -> bytearray:
    data[rng.integers(len(data))] ^= 1 << rng.integers(8)
    return data


def flip_the_end(data: bytearray, rng: np.random.Generator) -> bytearray:
    data[-rng.integers(1, min(60, len(data)) + 1)] ^= 1 << rng.integers(8)
    return data


def zero_a_run(data: bytearray, rng: np.random.Generator) -> bytearray:
    start = rng.integers(len(data))
    data[start : start + 64] = bytes(len(data[start : start + 64]))
    return data


def cut(data: bytearray, rng: np.random.Generator) -> bytearray:
    return data[: rng.integers(1, len(data))]


DAMAGE = {
    "flipped": flip,
    "flipped at the end": flip_the_end,
    "run zeroed": zero_a_run,
    "cut": cut,
    "zeroed": lambda data, rng: bytearray(len(data)),
    "emptied": lambda data, rng: bytearray(),
    "deleted": lambda data, rng: None,
}


def some(store: Path, most: int, rng: np.random.Generator) -> list[Path]:
    """The root's metadata, and some of the other files: of every array one at least, if there is room."""
    arrays: dict[Path, list[Path]] = {}
    for file in rng.permutation(sorted(path for path in store.rglob("*") if path.is_file())):
        arrays.setdefault(file.parent, []).append(file)
    rest = [file for files in arrays.values() for file in files[1:]]
    return list(dict.fromkeys([store / "zarr.json", *(files[0] for files in arrays.values()), *rest]))[:most]


def damage(run: Path, name: str, how: str, seed: int, most: int) -> list[str]:
    """Damage files of a store one by one; return what was not told as it should be."""
    store, rng = run / f"{name}.zarr", np.random.default_rng([seed, zlib.crc32(f"{name}{how}".encode())])
    good, wrong = read(store), []
    for file in some(store, most, rng):
        whole = file.read_bytes()
        broken = DAMAGE[how](bytearray(whole), rng)
        if broken == whole:
            continue
        file.unlink() if broken is None else file.write_bytes(broken)
        faults = {fault.file for fault in verify(store).faults}
        try:
            same = read(store) == good
            if not same:
                wrong.append(f"{file}: read in silence")
            if file not in faults and file.name != "zarr.json":  # of that, white space may be damaged
                wrong.append(f"{file} is sound to verify")
        except StoreError as error:
            if str(file) != error.where or not error.remedy:
                wrong.append(f"{file}: {error}")
            if file not in faults:
                wrong.append(f"{file} is not named by verify")
        except Exception as error:  # noqa: BLE001  any other is what this test is for
            wrong.append(f"{file}: {type(error).__name__}: {error}")
        file.write_bytes(whole)
    return wrong


@pytest.mark.parametrize("name", STORES)
@pytest.mark.parametrize("how", DAMAGE)
def test_no_damage_is_silent(run, name, how):
    assert damage(run, name, how, seed=0, most=10) == []


# What others see


def test_zarr_and_xarray_raise_where_a_bit_is_flipped(run):
    for store, name in (("movie", "0"), ("results", "fit"), ("drift", "drift"), ("columns", "kind")):
        with spoiled(next(iter((run / f"{store}.zarr" / name).glob("c.*")))):
            with pytest.raises((ValueError, RuntimeError), match=r"(?i)checksum"):
                zarr.open_array(str(run / f"{store}.zarr" / name), mode="r")[...]
            with pytest.raises((ValueError, RuntimeError), match=r"(?i)checksum"):
                xr.open_zarr(run / f"{store}.zarr", consolidated=False, chunks=None)[name].load()


def test_zarrs_raises_where_whole_chunks_are_read(run):
    with spoiled(next((run / "results.zarr" / "fit").glob("c.*"))):
        with zarr.config.set({"codec_pipeline.path": "zarrs.ZarrsCodecPipeline"}):
            array = zarr.open_array(str(run / "results.zarr" / "fit"), mode="r")
        with pytest.raises(RuntimeError, match="checksum"):
            array[...]


@contextmanager
def spoiled(file: Path):
    """Flip a bit of a file; mend it in the end."""
    whole = file.read_bytes()
    at = min(30, len(whole) // 2)
    file.write_bytes(whole[:at] + bytes([whole[at] ^ 4]) + whole[at + 1 :])
    try:
        yield file
    finally:
        file.write_bytes(whole)


def test_a_chunk_is_one_file_without_folders(run):
    folders = {file.parent for name in STORES for file in (run / f"{name}.zarr").rglob("c.*")}
    assert all((folder / "zarr.json").exists() for folder in folders)
    assert not [path for path in run.rglob("c") if path.is_dir()]


# Errors of the system are no damage


def test_an_error_of_the_disk_is_not_called_damage(run, monkeypatch):
    def fail(*_):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    def told(place, name, work) -> StoreError:
        with monkeypatch.context() as patched:
            patched.setattr(place, name, fail)
            with pytest.raises(StoreError, match="cannot be read") as error:
                work()
        assert error.value.__cause__.errno == errno.EIO
        assert "damaged" not in str(error.value)
        return error.value

    movie, tracks = open_movie(run / "movie.zarr"), open_results(run / "results.zarr")
    assert "frames 0 to 1" in told(os, "preadv", lambda: movie.read(0, 1)).what
    told(zarr.storage._local, "_get", lambda: tracks["fit"].compute(scheduler="synchronous"))
    told(zarr.storage._local, "_get", lambda: datasets.open_dataset(run / "drift.zarr"))
    told(damages, "read_small", lambda: store_metadata.attributes(run / "drift.zarr"))


# Formats


def rewritten(store: Path, change) -> None:
    """Change what a store says of itself, as a program would that knows its checksum."""
    metadata = json.loads((store / "zarr.json").read_text())
    change(metadata["attributes"]["tract_dask"])
    metadata["attributes"]["tract_dask"].pop("checksum", None)
    metadata["attributes"]["tract_dask"]["checksum"] = store_metadata.digest(metadata)
    (store / "zarr.json").write_text(json.dumps(metadata))


@pytest.fixture
def copy(run, tmp_path) -> Path:
    shutil.copytree(run, tmp_path / "out")
    return tmp_path / "out"


@pytest.mark.parametrize("name", STORES)
def test_every_store_says_its_format_and_a_newer_one_is_refused_by_name(copy, name):
    store = copy / f"{name}.zarr"
    assert store_metadata.attributes(store)["format"] == store_metadata.FORMAT == 2
    rewritten(store, lambda about: about.update(format=7, versions={"tract_dask": "9.1"}))
    with pytest.raises(MissingStoreError, match=r"newer version.*format 7, of version 9\.1"):
        read(store)


def test_a_store_without_its_checksum_is_damaged(copy):
    metadata = json.loads((copy / "drift.zarr" / "zarr.json").read_text())
    del metadata["attributes"]["tract_dask"]["checksum"]
    (copy / "drift.zarr" / "zarr.json").write_text(json.dumps(metadata))
    with pytest.raises(StoreError, match="damaged"):
        datasets.open_dataset(copy / "drift.zarr")


def test_a_dataset_of_format_1_is_read(tmp_path):
    dataset = xr.Dataset({"status_ref": ("column_id", np.zeros(3, np.uint8))}, {"column_id": [1, 2, 3]})
    dataset.attrs["tract_dask"] = {"kind": "columns", "complete": True}
    dataset.to_zarr(tmp_path / "old.zarr", zarr_format=3, consolidated=False)  # leaves out a chunk of zeros
    xr.testing.assert_equal(datasets.open_dataset(tmp_path / "old.zarr"), dataset)
    assert verify(tmp_path / "old.zarr").without_checksums == (tmp_path / "old.zarr",)


def test_a_movie_of_format_1_is_read_or_refused_by_name(tmp_path):
    frames = np.random.default_rng(0).poisson(9, (4, 32, 40)).astype("u2")
    group = zarr.create_group(str(tmp_path / "old.zarr"), zarr_format=3)
    group.create_array("0", shape=frames.shape, chunks=(2, 32, 40), shards=(2, 32, 40), dtype="u2")[...] = frames
    about = {"kind": "movie", "complete": True, "shape": [4, 32, 40], "dtype": "uint16", "key": "k", "format": "npy"}
    group.attrs["tract_dask"] = about
    with pytest.raises(MissingStoreError, match=r"another version.*frames_per_shard"):
        open_movie(tmp_path / "old.zarr")


# Running again, and repairing


def again(copy: Path, source: Path) -> set[str]:
    """Run once more; return the stages that had work."""
    events = []
    with (
        LocalCluster(processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None) as local,
        Client(local) as client,
    ):
        pipeline.run(source, copy, SETTINGS, client=client, report=False, on_event=events.append)
    return {event.stage for event in events if isinstance(event, StageDone) and not event.reused}


@pytest.mark.parametrize("name", ["drift", "results"])
def test_the_remedy_helps_and_nothing_else_is_made_anew(run, copy, name):
    store = copy / f"{name}.zarr"
    (next(store.rglob("c.0*"))).write_bytes(b"")
    with pytest.raises(StoreError, match=f"Remove .*{name}.zarr and run the command") as told:
        read(store)
    assert str(store) in told.value.remedy
    shutil.rmtree(store)
    assert again(copy, run.parent / "movie.npy") == {"fit" if name == "results" else name}
    for other in STORES:
        assert arrays_of(copy / f"{other}.zarr") == arrays_of(run / f"{other}.zarr")


def arrays_of(store: Path) -> dict[str, bytes]:
    return {str(file.relative_to(store)): file.read_bytes() for file in store.rglob("c.*")}


def test_damaged_columns_ask_for_the_table_too(run, copy):
    (copy / "columns.zarr" / "x_ref" / "c.0").write_bytes(b"")
    with pytest.raises(StoreError, match=r"columns\.csv.*--columns-csv") as told:
        again(copy, run.parent / "movie.npy")
    assert "columns.zarr" in told.value.where
    shutil.rmtree(copy / "columns.zarr")
    (copy / "columns.csv").rename(copy.parent / "columns.csv")
    assert again(copy, run.parent / "movie.npy") == {"columns"}


@pytest.mark.parametrize("name", STORES)
def test_damaged_metadata_are_neither_overwritten_nor_taken_for_nothing(run, copy, name):
    file = copy / f"{name}.zarr" / "zarr.json"
    whole = arrays_of(file.parent)
    for data in (b"", file.read_bytes()[:-20], file.read_bytes().replace(b'"tract_dask"', b'"tract_dasj"', 1), None):
        file.unlink() if data is None else file.write_bytes(data)
        with pytest.raises(StoreError, match=r"(damaged|missing).*Remove"):
            again(copy, run.parent / "movie.npy")
    assert arrays_of(file.parent) == whole


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_folder_in_the_place_of_a_file_is_refused(run, copy, overwrite):
    for name in ("columns.csv", "report.html", "events.jsonl"):
        (copy / name).unlink(missing_ok=True)
        (copy / name).mkdir()
        with pytest.raises(DestinationError, match="a folder lies where a file is written"):
            pipeline.run(run.parent / "movie.npy", copy, SETTINGS, report=False, overwrite=overwrite)
        (copy / name).rmdir()


def test_overwrite_replaces_a_damaged_run(run, copy):
    (copy / "movie.zarr" / "zarr.json").write_bytes(b"")
    (copy / "columns.zarr" / "zarr.json").write_bytes(b"noise")
    with (
        LocalCluster(processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None) as local,
        Client(local) as client,
    ):
        pipeline.run(
            run.parent / "movie.npy", copy, SETTINGS, client=client, report=False, until="convert", overwrite=True
        )
    assert arrays_of(copy / "movie.zarr") == arrays_of(run / "movie.zarr")
    assert not (copy / "columns.zarr").exists()


def test_convert_with_overwrite_begins_anew_whatever_is_there(run, copy):
    os.truncate(copy / "movie.zarr" / "0" / "c.1.0.0", 100)
    with (
        LocalCluster(processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None) as local,
        Client(local) as client,
    ):
        one_stage.run_convert(run.parent / "movie.npy", copy / "movie.zarr", SETTINGS, client=client, overwrite=True)
    assert arrays_of(copy / "movie.zarr") == arrays_of(run / "movie.zarr")


def command(*args) -> tuple[int, str]:
    result = CliRunner().invoke(main, ["verify", *map(str, args)])
    return result.exit_code, result.stdout


def test_verify_names_what_is_wrong_and_repairs_the_movie(run, copy):
    assert command(copy) == (0, command(copy)[1])
    assert "all sound" in command(copy)[1]
    movie = copy / "movie.zarr"
    shard, binned, lost = movie / "0" / "c.1.0.0", movie / "binned" / "4" / "c.2.0.0", movie / "frame_mean" / "c.0"
    shard.write_bytes(shard.read_bytes()[:-5])
    binned.unlink()
    (movie / "0" / ".c.3.0.0.17.partial").write_bytes(b"half")
    code, text = command(copy)
    assert code == 1
    assert f"{shard}: damaged, frames 2 to 3" in text
    assert f"{binned}: missing, frames 4 to 5" in text
    assert "left over" in text
    assert f"tract-dask verify {movie} --repair" in text
    assert "2 are not sound" in text
    code, text = command(copy, "--json")
    found = json.loads(text)
    assert (code, found["sound"]) == (1, False)
    assert {(Path(fault["file"]).name, fault["stage"], fault["what"]) for fault in found["faults"]} == {
        ("c.1.0.0", "convert", "damaged"),
        ("c.2.0.0", "convert", "missing"),
        (".c.3.0.0.17.partial", "convert", "left over"),
    }
    assert command(copy, "--repair")[0] == 0
    lost.unlink()
    (movie / "y" / "c.0").write_bytes(b"")
    assert command(movie)[0] == 1
    assert command(movie, "--repair")[0] == 0
    (movie / "0" / ".c.3.0.0.17.partial").unlink()
    assert arrays_of(movie) == arrays_of(run / "movie.zarr")
    assert read(movie) == read(run / "movie.zarr")


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ("movie.zarr/0/c.0.0.0", "movie.zarr/0/c.1.0.0"),
        ("movie.zarr/binned/4/c.0.0.0", "movie.zarr/binned/4/c.1.0.0"),
        ("results.zarr/fit/c.0.0.0", "results.zarr/stderr/c.0.0.0"),
    ],
)
def test_shards_that_change_places_are_named(copy, first, second):
    """Each is sound in itself: every checksum in it is true."""
    first, second = copy / first, copy / second
    for one, other in ((first, copy / "aside"), (second, first), (copy / "aside", second)):
        one.rename(other)
    found = verify(copy)
    assert {fault.file for fault in found.faults if fault.what == "damaged"} == {first, second}
    assert all("belongs to another place" in fault.why for fault in found.faults)
    store = copy / first.relative_to(copy).parts[0]
    reads = [lambda: read(store)]
    if store.stem == "results":
        reads += [lambda: open_results(store)["stderr"][:1, :1].load(), lambda: datasets.open_array(second.parent)[0]]
    for look in reads:
        with pytest.raises(StoreError, match="belongs to another place") as error:
            look()
        assert Path(error.value.where) in (first, second)


@contextmanager
def swapped(first: Path, second: Path):
    """Let two files change places; put them back in the end."""
    kept = first.read_bytes(), second.read_bytes()
    first.write_bytes(kept[1])
    second.write_bytes(kept[0])
    try:
        yield
    finally:
        first.write_bytes(kept[0])
        second.write_bytes(kept[1])


def twins(run: Path) -> list[tuple[Path, Path]]:
    """All pairs of files of a run's stores that have the same size and other bytes; of shards of an array, one pair."""
    files: dict[int, list[Path]] = {}
    for file in sorted(file for name in STORES for file in (run / f"{name}.zarr").rglob("*") if file.is_file()):
        files.setdefault(file.stat().st_size, []).append(file)
    return [
        pair for alike in files.values() for pair in combinations(alike, 2) if len({*map(Path.read_bytes, pair)}) > 1
    ]


def test_no_two_files_change_places_in_silence(run):
    """Whether arrays, chunks or metadata, of one store or of two: every checksum in them is true."""
    pairs, wrong = twins(run), []
    for pair in pairs:
        with swapped(*pair):
            for store in {store_of(file) for file in pair}:
                names = [file.parent.name for file in pair if store in file.parents]
                try:
                    read_movie(store) if store.stem == "movie" else datasets.open_dataset(store, only=names)
                    wrong.append(f"{pair}: read in silence")
                except StoreError as error:
                    wrong += [] if Path(error.where) in pair and error.remedy else [f"{pair}: {error}"]
                named = {fault.file for fault in verify(store).faults}
                wrong += (
                    [] if named == {file for file in pair if store in file.parents} else [f"{pair}: verify {named}"]
                )
    assert len(pairs) > 20
    assert wrong == []


def test_an_array_of_another_run_in_the_place_of_ours_is_refused(copy):
    """Stores of the same layout: only the values differ."""
    other = datasets.open_dataset(copy / "drift.zarr")
    other["drift"] = other["drift"] + 0.5
    datasets.write_dataset(other, copy / "other.zarr")
    file = copy / "drift.zarr" / "drift" / "c.0.0"
    shutil.copy(copy / "other.zarr" / "drift" / "c.0.0", file)
    shutil.rmtree(copy / "other.zarr")
    with pytest.raises(StoreError, match="belongs to another place"):
        datasets.open_dataset(copy / "drift.zarr")
    (fault,) = verify(copy).faults
    assert (fault.file, fault.why) == (file, "this file belongs to another place, or to another store")


def test_a_change_of_the_times_that_is_cut_off_is_ended_by_the_next_run(copy, monkeypatch):
    store, scale = copy / "results.zarr", {"pixel_size_pm": 8.0, "frame_time_s": 0.5, "dose": None}
    time = np.arange(open_results(store).sizes["frame"]) * 0.5

    def killed(*_, **__):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(store_metadata, "update_attributes", killed)
        with pytest.raises(KeyboardInterrupt):
            calibrate(store, time, **scale)
    assert verify(store).sound
    calibrate(store, time, **scale)
    np.testing.assert_array_equal(open_results(store)["time"], time)
    with swapped(store / "time" / "c.0", store / "frame" / "c.0"), pytest.raises(StoreError):
        open_results(store)["time"].load()


def test_results_of_a_run_without_marks_are_read(copy):
    """Stores of earlier versions have none, and no list of chunks."""
    store = copy / "results.zarr"
    marked = open_results(store).load()
    rewritten(store, lambda about: (about.pop("shards_marked"), about.pop("chunks")))
    xr.testing.assert_equal(open_results(store).load(), marked)
    assert verify(store).sound


def test_stores_of_two_runs_in_one_folder_are_named(run, copy, tmp_path):
    """Somebody has put the movie of another run, of the same shape, in the place of the first."""
    np.save(tmp_path / "other.npy", Scene(amplitude=50.0).counts())
    convert(tmp_path / "other.npy", tmp_path / "other.zarr", settings=SETTINGS.convert)
    shutil.rmtree(copy / "movie.zarr")
    shutil.copytree(tmp_path / "other.zarr", copy / "movie.zarr")
    found = verify(copy)
    others = [f"{name}.zarr" for name in ("drift", "sum", "columns", "results")]
    assert [fault.store.name for fault in found.faults if fault.what == "of another run"] == others
    assert not found.sound
    assert "Move the stores of one of the two runs out of" in found.text()
    assert command(copy)[0] == 1
    page = write_report(copy, tmp_path / "report.html", figures=False).read_text()
    assert "Stores of two runs" in page
    assert "drift.zarr and sum.zarr and columns.zarr and results.zarr" in page
    with pytest.raises(DestinationError, match="another movie"):
        pipeline.run(run.parent / "movie.npy", copy, SETTINGS)


def test_verify_is_silent_about_what_people_and_kills_do(copy):
    table, events = copy / "columns.csv", copy / "events.jsonl"
    assert verify(copy).notes == ()
    lines = table.read_text().splitlines()
    table.write_text("\ufeff" + "\r\n".join(lines[:-1]))
    events.write_bytes(events.read_bytes()[:-9])
    found = verify(copy)
    assert found.sound
    assert found.remedies == []
    assert [f"the {len(lines) - 2} columns in it" in note or "not whole" in note for note in found.notes] == [
        True,
        True,
    ]
    (copy / "columns.png").unlink()
    assert verify(copy).sound
    assert verify(copy / "movie.zarr").notes == ()


def test_verify_compares_the_settings_of_the_stores(run, copy):
    before = (copy / "run.toml").read_text()
    changed = before.replace("threshold = 1.6", "threshold = 2.5").replace('codec = "lz4"', 'codec = "zstd"')
    (copy / "run.toml").write_text(changed.replace("shard_mb = 1.0", "shard_mb = 1.5"))
    (note,) = verify(copy).notes
    assert "movie.zarr (convert.codec); results.zarr (fit.threshold)" in note


BESIDE = {
    "run.toml garbled": (
        "run.toml",
        lambda data: data[:100] + b"\xff\x00" + data[100:],
        "damaged",
        "writes the file again",
    ),
    "run.toml empty": ("run.toml", lambda data: b"", "damaged", "writes the file again"),
    "run.toml cut": ("run.toml", lambda data: data[: data.index(b"[fit]")], "damaged", "writes the file again"),
    "run.toml gone": ("run.toml", None, "missing", "writes the file again"),
    "a setting unknown": (
        "run.toml",
        lambda data: data.replace(b"threshold", b"thresold"),
        "damaged",
        "writes the file again",
    ),
    "columns.csv cut": (
        "columns.csv",
        lambda data: data[: data.index(b"\n", 200) + 5],
        "damaged",
        "columns.csv, or remove",
    ),
    "columns.csv empty": ("columns.csv", lambda data: b"", "damaged", "columns.csv, or remove"),
    "columns.csv gone": ("columns.csv", None, "missing", "columns are found again"),
    "figure flipped": ("columns.png", lambda data: data[:-30] + b"\0" * 3 + data[-27:], "damaged", "Remove"),
    "figure cut": ("columns.png", lambda data: data[:-12], "damaged", "Remove"),
    "report cut": ("report.html", lambda data: b"<html><body>", "damaged", "tract-dask report"),
}


@pytest.mark.parametrize("name", BESIDE)
def test_verify_names_small_files_that_cannot_be_used(copy, name):
    file, garble, what, advice = BESIDE[name]
    place = copy / file
    if garble is None:
        place.unlink()
    else:
        place.write_bytes(garble(place.read_bytes() if place.exists() else b""))
    (fault,) = (found := verify(copy)).faults
    assert (fault.file, fault.store, fault.what) == (place, copy, what)
    assert not found.sound
    assert advice in found.remedies[0]
    assert command(copy)[0] == 1


@pytest.mark.parametrize("name", ["run.toml", "columns.csv"])
def test_a_small_file_that_is_mended_as_advised_is_sound(run, copy, name):
    (copy / name).unlink()
    with (
        LocalCluster(processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None) as local,
        Client(local) as client,
    ):
        pipeline.run(run.parent / "movie.npy", copy, SETTINGS, client=client, report=False)
    assert verify(copy).sound
    assert (copy / name).read_bytes() == (run / name).read_bytes()


def test_repair_refuses_another_source(run, copy, tmp_path):
    (copy / "movie.zarr" / "0" / "c.0.0.0").unlink()
    store_metadata.update_attributes(copy / "movie.zarr", source=str(tmp_path / "other.npy"))
    np.save(tmp_path / "other.npy", Scene(amplitude=50.0).counts())
    code, _ = command(copy, "--repair")
    assert code == 2
    (tmp_path / "other.npy").unlink()
    assert command(copy, "--repair")[0] == 2


def test_verify_takes_an_unfinished_store_for_what_it_is(copy):
    store_metadata.update_attributes(copy / "movie.zarr", complete=False)
    (copy / "movie.zarr" / "0" / "c.0.0.0").unlink()
    found = verify(copy / "movie.zarr")
    assert found.sound
    assert found.unfinished == (copy / "movie.zarr",)
    (copy / "movie.zarr" / "0" / "c.1.0.0").write_bytes(b"")
    assert not verify(copy / "movie.zarr").sound


def test_verify_reads_the_parts_of_a_fit_that_is_not_finished(copy):
    store = copy / "results.zarr"
    tracks, step = open_results(store).load(), open_movie(copy / "movie.zarr").frames_per_shard
    store_metadata.update_attributes(store, complete=False)
    journal = Journal(journal_beside(store), store_metadata.attributes(store)["key"])
    for shard in split(tracks.sizes["frame"], step)[:2]:
        values = {name: tracks[name].to_numpy()[shard.start : shard.stop] for name in SHARDED}
        with journal.batch() as done:
            write(journal.path, shard, values, step)
            done(shard, {})
    assert verify(store).sound
    (part,) = journal.path.glob("*.parts")
    data = bytearray(part.read_bytes())
    data[40] ^= 1
    part.write_bytes(data)
    (fault,) = (found := verify(store)).faults
    assert (fault.file, fault.what, fault.frames) == (part, "damaged", (0, step))
    assert found.remedies == ["Run the same command again: it makes again what is damaged"]


def test_verify_says_where_there_is_nothing(tmp_path):
    with pytest.raises(MissingStoreError, match="no store here"):
        verify(tmp_path)


def test_a_store_that_was_being_removed_is_gone(tmp_path, monkeypatch):
    """A process that is killed while it deletes a store leaves none behind that looks damaged."""
    store = tmp_path / "movie.zarr"
    for name in (".", "frame_bad_pixels"):
        (store / name).mkdir(parents=True, exist_ok=True)
        (store / name / "zarr.json").write_text("{}")

    def killed(folder):
        (folder / "zarr.json").unlink()
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(store_files.shutil, "rmtree", killed)
        with pytest.raises(KeyboardInterrupt):
            store_files.remove(store)
    assert store_metadata.attributes(store) == {}
    store_files.remove(store)
    assert not list(tmp_path.iterdir())


def test_a_store_that_comes_after_both_looks_is_not_there_yet(tmp_path, monkeypatch):
    marks = iter([False, True])
    monkeypatch.setattr(store_metadata, "_is_marked", lambda path: next(marks))
    assert store_metadata.attributes(tmp_path / "late.zarr") == {}


def test_a_store_that_comes_between_two_looks_is_not_damaged(tmp_path, monkeypatch):
    aside, store = tmp_path / "aside", tmp_path / "sum.zarr"
    datasets.write_dataset(
        xr.Dataset({"exposure": ("x", np.ones(3))}, attrs={store_metadata.ATTRIBUTE: {"key": "k"}}), aside
    )
    look = store_metadata.read_json

    def read_json(file):
        found = look(file)
        if aside.exists():
            aside.rename(store)
        return found

    monkeypatch.setattr(store_metadata, "read_json", read_json)
    assert store_metadata.attributes(store)["key"] == "k"
