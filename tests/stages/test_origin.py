"""What a movie was made from: it may not change meanwhile, and need not be there afterwards."""

import dataclasses
import os
import shutil
import time
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from conftest import Scene

from tract_dask.errors import ChangedSourceError, DestinationError, SourceError
from tract_dask.progress import STAGES, ShardDone, StageDone, StageStarted, Warned
from tract_dask.readers import open_source
from tract_dask.run import one_stage, pipeline, session
from tract_dask.run.verify import repair, verify
from tract_dask.settings import ConvertSettings, FitSettings, MetadataSettings, RunSettings, SourceSettings
from tract_dask.stages.convert import shard as convert_shard
from tract_dask.stages.convert import stage as convert_stage
from tract_dask.stages.convert.origin import movie_key
from tract_dask.stages.convert.stage import convert
from tract_dask.store import files as store_files
from tract_dask.store import keys, provenance
from tract_dask.store import metadata as store_metadata
from tract_dask.store.keys import counted
from tract_dask.store.movie import open_movie
from tract_dask.store.stamps import Stamps

SMALL = ConvertSettings(shard_mb=1)
FRAMES = np.arange(24, dtype=np.uint16)[:, None, None] + np.full((24, 96, 80), 100, np.uint16)
OTHER = FRAMES[::-1].copy()


class Interrupted(Exception):
    pass


def after(count: int, act):
    """Return a sink that acts after so many shards."""
    seen = []

    def sink(event):
        if isinstance(event, ShardDone):
            seen.append(event)
            if len(seen) == count:
                act()

    return sink


def interrupt():
    raise Interrupted


def rewrite(path: Path, data: bytes, *, keep_time: bool) -> None:
    before = path.stat()
    with path.open("r+b") as file:
        file.write(data)
        file.truncate()
    if keep_time:
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))


def replace(path: Path, data: bytes) -> None:
    before = path.stat()
    aside = path.with_suffix(".new")
    aside.write_bytes(data)
    os.utime(aside, ns=(before.st_atime_ns, before.st_mtime_ns))
    aside.replace(path)


def as_tiff(frames: np.ndarray, path: Path) -> Path:
    tifffile.imwrite(path, frames, photometric="minisblack")
    return path


CHANGES = {
    "rewritten": lambda path, data: rewrite(path, data, keep_time=False),
    "rewritten, its time set back": lambda path, data: rewrite(path, data, keep_time=True),
    "replaced, its time set back": replace,
    "appended to": lambda path, data: path.write_bytes(path.read_bytes() + data),
    "truncated": lambda path, data: os.truncate(path, len(data) // 2),
    "removed": lambda path, data: path.unlink(),
}


@pytest.mark.parametrize("change", CHANGES)
def test_a_movie_that_changes_while_it_is_converted_is_refused(tmp_path, change):
    path, other = as_tiff(FRAMES, tmp_path / "movie.tif"), as_tiff(OTHER, tmp_path / "other.tif").read_bytes()
    original = path.read_bytes()
    with pytest.raises(ChangedSourceError, match="has changed since the conversion began") as caught:
        convert(path, tmp_path / "m.zarr", settings=SMALL, on_event=after(3, lambda: CHANGES[change](path, other)))
    assert str(path) in caught.value.where
    assert caught.value.expected != caught.value.got
    assert "conversion starts again" in caught.value.remedy
    assert not (tmp_path / "m.zarr").exists()  # some of its shards may be of either
    path.write_bytes(original)
    np.testing.assert_array_equal(open_movie(convert(path, tmp_path / "m.zarr", settings=SMALL)).read(0, 24), FRAMES)


def test_a_change_after_the_last_shard_was_read_is_refused(tmp_path):
    path = as_tiff(FRAMES, tmp_path / "movie.tif")
    other = as_tiff(OTHER, tmp_path / "other.tif").read_bytes()
    with pytest.raises(ChangedSourceError):
        convert(
            path, tmp_path / "m.zarr", settings=SMALL, on_event=after(8, lambda: rewrite(path, other, keep_time=True))
        )
    assert not store_metadata.attributes(tmp_path / "m.zarr").get("complete")


def test_a_change_while_a_shard_is_read_keeps_it_from_its_place(tmp_path, monkeypatch):
    path, placed = tmp_path / "movie.npy", tmp_path / "m.zarr" / "0"
    np.save(path, FRAMES)
    read, seen = convert_shard._read_ahead, []

    def change_meanwhile(source, shard, depth):
        yield from read(source, shard, depth)
        if shard.index == 2:
            rewrite(path, path.read_bytes()[::-1], keep_time=True)

    monkeypatch.setattr(convert_shard, "_read_ahead", change_meanwhile)
    clear = convert_stage._clear
    monkeypatch.setattr(
        convert_stage, "_clear", lambda store: (seen.append(len(list(placed.glob("c.*")))), clear(store))
    )
    with pytest.raises(ChangedSourceError):
        convert(path, tmp_path / "m.zarr", settings=SMALL)
    assert seen[-1] == 2


def test_an_error_of_the_reader_is_told_as_what_it_comes_from(tmp_path, monkeypatch):
    path = tmp_path / "movie.npy"
    np.save(path, FRAMES)

    def fail(source, shard, depth):
        os.truncate(path, 1000)
        raise SourceError("the file ends too early")

    monkeypatch.setattr(convert_shard, "_read_ahead", fail)
    with pytest.raises(ChangedSourceError, match=r"Expected .* bytes; got 1,000 bytes"):
        convert(path, tmp_path / "m.zarr", settings=SMALL)


def sequence(folder: Path, frames: np.ndarray) -> Path:
    folder.mkdir()
    for number, frame in enumerate(frames):
        tifffile.imwrite(folder / f"frame_{number:03}.tif", frame)
    return folder


@pytest.mark.parametrize("number", [1, 23])
def test_a_file_of_a_sequence_that_is_replaced_is_refused(tmp_path, number):
    folder = sequence(tmp_path / "frames", FRAMES)
    changed, other = folder / f"frame_{number:03}.tif", (folder / "frame_010.tif").read_bytes()
    with pytest.raises(ChangedSourceError) as caught:
        convert(folder, tmp_path / "m.zarr", settings=SMALL, on_event=after(3, lambda: replace(changed, other)))
    assert caught.value.where == str(changed)


LISTINGS = {
    "added": (lambda folder: shutil.copy(folder / "frame_023.tif", folder / "frame_024.tif"), "25 files: frame_024"),
    "taken away": (lambda folder: (folder / "frame_023.tif").unlink(), r"none"),
    "renamed": (lambda folder: (folder / "frame_023.tif").rename(folder / "frame_999.tif"), r"none"),
    "of another format": (lambda folder: np.save(folder / "other.npy", FRAMES), "several formats"),
}


@pytest.mark.parametrize(
    ("change", "pattern"), [*((change, "") for change in LISTINGS), ("added", "frame_*.tif"), ("renamed", "*.tif")]
)
def test_a_sequence_that_gains_or_loses_a_file_while_it_is_converted_is_refused(tmp_path, change, pattern):
    folder, (act, message) = sequence(tmp_path / "frames", FRAMES), LISTINGS[change]
    with pytest.raises(SourceError, match=message) as caught:
        convert(folder / pattern, tmp_path / "m.zarr", settings=SMALL, on_event=after(8, lambda: act(folder)))
    assert str(folder) in caught.value.where
    assert not store_metadata.attributes(tmp_path / "m.zarr").get("complete")


def test_a_list_or_a_pattern_of_files_may_gain_others_beside_them(tmp_path):
    folder = sequence(tmp_path / "frames", FRAMES)
    for number, source in enumerate((open_source(sorted(folder.iterdir())), folder / "frame_*.tif")):
        act = after(8, lambda: shutil.copy(folder / "frame_000.tif", folder / "other.tif"))
        movie = convert(source, tmp_path / f"{number}.zarr", settings=SMALL, on_event=act)
        assert open_movie(movie).n_frames == 24
        (folder / "other.tif").unlink()


def test_a_list_of_files_is_converted_and_repaired_in_its_order(tmp_path):
    order = [2, 0, 3, 1]
    for number in order:
        np.save(tmp_path / f"frame_{number}.npy", FRAMES[number])
    listed = open_source([tmp_path / f"frame_{number}.npy" for number in order])
    movie = convert(listed, tmp_path / "movie.zarr", settings=SMALL)
    assert convert(listed, movie, settings=SMALL) == movie
    np.testing.assert_array_equal(open_movie(movie).read(0, 4), FRAMES[order])
    next((movie / "0").glob("c.*")).unlink()
    repair(verify(movie))
    assert verify(movie).sound
    np.testing.assert_array_equal(open_movie(movie).read(0, 4), FRAMES[order])


@pytest.mark.parametrize("pattern", ["", "frame_*.npy"])
def test_the_shards_of_a_sequence_are_made_anew(tmp_path, pattern):
    place = tmp_path / "frames [1]"
    place.mkdir()
    for number in range(4):
        np.save(place / f"frame_{number}.npy", FRAMES[number])
    movie = convert(place / pattern, tmp_path / "movie.zarr", settings=SMALL)
    next((movie / "0").glob("c.*")).unlink()
    repair(verify(movie))
    assert verify(movie).sound
    np.testing.assert_array_equal(open_movie(movie).read(0, 4), FRAMES[:4])
    assert not list(tmp_path.glob(".movie*"))


def test_a_shard_asks_about_its_own_files_only(tmp_path, monkeypatch):
    asked = []
    check = Stamps.check
    monkeypatch.setattr(
        Stamps, "check", lambda self, files, part=slice(None): (asked.append(part), check(self, files, part))[1]
    )
    convert(sequence(tmp_path / "frames", FRAMES), tmp_path / "m.zarr", settings=SMALL)
    assert asked[:4] == [slice(0, 3), slice(0, 3), slice(3, 6), slice(3, 6)]
    assert asked[-1] == slice(None)
    assert len(asked) == 2 * 8 + 1


def test_files_of_a_part_of_a_sequence(tmp_path):
    (tmp_path / "stacks").mkdir()
    for number, length in enumerate((2, 5, 1, 4)):
        np.save(tmp_path / "stacks" / f"part_{number}.npy", FRAMES[:length])
    source = open_source(tmp_path / "stacks")
    assert [source.files_of(*part) for part in ((0, 2), (1, 3), (6, 8), (8, 12), (0, 12))] == [
        slice(0, 1),
        slice(0, 2),
        slice(1, 3),
        slice(3, 4),
        slice(0, 4),
    ]


def test_another_machine_is_not_asked_for_the_time_that_file_systems_disagree_on(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"1")
    far = dataclasses.replace(Stamps.of([path]), host="far")
    time.sleep(0.02)
    path.chmod(0o600)
    far.check([path])
    path.write_bytes(b"12")
    with pytest.raises(ChangedSourceError, match="1 bytes; got 2 bytes"):
        far.check([path])


# After an interruption


def test_an_interrupted_conversion_goes_on_after_a_move_and_begins_anew_after_a_change(tmp_path):
    path = as_tiff(FRAMES, tmp_path / "movie.tif")
    with pytest.raises(Interrupted):
        convert(path, tmp_path / "m.zarr", settings=SMALL, on_event=after(3, interrupt))
    (tmp_path / "archive").mkdir()
    moved = shutil.copy(path, tmp_path / "archive" / "moved.tif")
    path.unlink()
    os.utime(moved, (1, 1))
    with pytest.raises(Interrupted):
        convert(moved, tmp_path / "m.zarr", settings=SMALL, on_event=after(1, interrupt))
    rewrite(Path(moved), as_tiff(OTHER, tmp_path / "other.tif").read_bytes(), keep_time=True)
    events = []
    convert(moved, tmp_path / "m.zarr", settings=SMALL, on_event=events.append)
    assert [event.done_frames for event in events if isinstance(event, StageStarted)] == [0]
    np.testing.assert_array_equal(open_movie(tmp_path / "m.zarr").read(0, 24), OTHER)


def test_where_samples_alone_are_compared_a_later_time_begins_anew(tmp_path, monkeypatch):
    monkeypatch.setattr(convert_stage, "WHOLE_BYTES", 1000)
    path = as_tiff(FRAMES, tmp_path / "movie.tif")
    for later, expected in ((False, 9), (True, 0)):
        with pytest.raises(Interrupted):
            convert(path, tmp_path / "m.zarr", settings=SMALL, on_event=after(3, interrupt), overwrite=True)
        if later:
            os.utime(path)
        events = []
        convert(path, tmp_path / "m.zarr", settings=SMALL, on_event=events.append)
        assert [event.done_frames for event in events if isinstance(event, StageStarted)] == [expected]
        assert any("starts again" in event.message for event in events if isinstance(event, Warned)) == later
        store_files.remove(tmp_path / "m.zarr")


# Fingerprints


def test_a_fingerprint_is_of_what_files_hold(tmp_path):
    one, other = tmp_path / "a.bin", tmp_path / "sub" / "b.bin"
    other.parent.mkdir()
    one.write_bytes(b"x" * 5000)
    shutil.copyfile(one, other)
    os.utime(other, (5, 5))
    assert provenance.fingerprint(one) == provenance.fingerprint(other)
    assert provenance.fingerprint(one, other) != provenance.fingerprint(one)


def noise(size: int) -> bytearray:
    return bytearray(np.random.default_rng(0).bytes(size))


@pytest.mark.parametrize("size", [1 << 20, (32 << 20) + 7, 80 << 20])
def test_a_movie_exported_anew_with_the_same_ends_has_another_fingerprint(tmp_path, size):
    path, data = tmp_path / "a.bin", noise(size)
    path.write_bytes(data)
    before, third = provenance.fingerprint(path), size // 3
    data[third : 2 * third] = data[third : 2 * third][::-1]
    path.write_bytes(data)
    assert provenance.fingerprint(path) != before


def test_a_bounded_amount_is_read_of_a_large_movie(tmp_path):
    sizes = [3 << 40, 5 << 40]
    blocks = list(provenance._samples(sizes))
    assert sum(count for _, _, count in blocks) < 9e6
    assert all(offset + count <= sizes[number] for number, offset, count in blocks)
    places = np.sort([offset + number * sizes[0] for number, offset, _ in blocks])
    assert np.diff(places).max() < sum(sizes) / 30


def test_one_file_of_a_long_sequence_that_is_replaced_changes_the_fingerprint(tmp_path, monkeypatch):
    monkeypatch.setattr(provenance, "WHOLE_BYTES", 1 << 10)
    files = [tmp_path / f"{number:04}.bin" for number in range(300)]
    for number, file in enumerate(files):
        file.write_bytes(np.random.default_rng(number).bytes(300))
    before = provenance.fingerprint(*files)
    files[217].write_bytes(np.random.default_rng(999).bytes(300))
    assert provenance.fingerprint(*files) != before


def master(folder: Path, frames: np.ndarray) -> Path:
    """Write a movie as a master file and two files behind it."""
    half = len(frames) // 2
    for number in range(2):
        with h5py.File(folder / f"data_{number}.h5", "w") as file:
            file["d"] = frames[half * number : half * number + half]
    layout = h5py.VirtualLayout(frames.shape, "u2")
    for number in range(2):
        source = h5py.VirtualSource(f"data_{number}.h5", "d", (half, *frames.shape[1:]))
        layout[half * number : half * number + half] = source
    with h5py.File(folder / "master.h5", "w") as file:
        file.create_virtual_dataset("entry/data", layout)
    return folder / "master.h5"


def test_every_file_behind_an_hdf5_master_counts(tmp_path):
    path = master(tmp_path, FRAMES)
    before = movie_key(open_source(path))
    with h5py.File(tmp_path / "data_1.h5", "r+") as file:
        file["d"][...] = FRAMES[12:][::-1]
    assert movie_key(open_source(path)) != before


def test_a_file_behind_an_hdf5_master_may_not_change_meanwhile_and_may_be_gone_later(tmp_path):
    path, store = master(tmp_path, FRAMES), tmp_path / "m.zarr"
    data = (tmp_path / "data_1.h5").read_bytes()
    act = after(2, lambda: rewrite(tmp_path / "data_1.h5", data, keep_time=True))
    with pytest.raises(ChangedSourceError, match=r"data_1\.h5"):
        convert(path, store, settings=SMALL, on_event=act)
    convert(path, store, settings=SMALL)
    (tmp_path / "data_1.h5").unlink()
    assert one_stage.run_convert(path, store, known()).shape == FRAMES.shape


def test_two_data_sets_of_one_file_are_two_movies(tmp_path):
    with h5py.File(tmp_path / "two.h5", "w") as file:
        file["a"], file["b"] = FRAMES, OTHER
    keys = {movie_key(open_source(f"{tmp_path}/two.h5::/{name}")) for name in "ab"}
    assert len(keys) == 2


# A complete movie, and its source somewhere else


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """A folder with a movie and the folder of its finished run, to be copied."""
    folder = tmp_path_factory.mktemp("finished")
    np.save(folder / "movie.npy", Scene().counts())
    run(folder / "movie.npy", folder / "out", known(pixel_size_pm=8.0))
    return folder


@pytest.fixture
def folder(finished, tmp_path) -> Path:
    shutil.copytree(finished, tmp_path / "run")
    return tmp_path / "run"


def known(fit: FitSettings | None = None, convert: ConvertSettings = SMALL, **metadata: float) -> RunSettings:
    return RunSettings(convert=convert, metadata=MetadataSettings(**metadata), fit=fit or FitSettings())


def run(source: Path | str, output: Path, settings: RunSettings, **more) -> tuple[set[str], list[str]]:
    """Run in this process; return the stages that worked, and the warnings."""
    events = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(session, "LazyClient", Nobody)
        pipeline.run(source, output, settings, on_event=events.append, report=False, **more)
    worked = {event.stage for event in events if isinstance(event, StageDone) and not event.reused}
    return worked, [event.message for event in events if isinstance(event, Warned)]


class Nobody:
    """A client of nothing: the work is done in this process."""

    def __init__(self, *_: object) -> None:
        pass

    def __call__(self) -> None:
        return None

    def close(self) -> None:
        pass


WIDER = known(FitSettings(threshold=3.0), pixel_size_pm=8.0)


def test_a_finished_run_goes_on_without_its_source(folder):
    (folder / "movie.npy").unlink()
    worked, warnings = run(folder / "movie.npy", folder / "out", WIDER)
    assert worked == {"fit"}
    assert ["is not there: the run goes on" in warning for warning in warnings] == [True]


def test_without_its_source_the_movie_keeps_what_the_file_said_and_takes_what_the_user_says(folder):
    (folder / "movie.npy").unlink()
    run(folder / "movie.npy", folder / "out", known(gain=2.0), until="convert")
    movie = open_movie(folder / "out" / "movie.zarr")
    assert (movie.gain, movie.pixel_size_pm) == (2.0, None)
    run(folder / "movie.npy", folder / "out", known(pixel_size_pm=8.0), until="convert")
    movie = open_movie(folder / "out" / "movie.zarr")
    assert (movie.gain, movie.pixel_size_pm) == (1.0, 8.0)


def test_moved_together_copied_and_archived_runs_go_on(folder, tmp_path):
    shutil.make_archive(str(tmp_path / "run"), "zip", folder.parent, folder.name)
    shutil.rmtree(folder)
    shutil.unpack_archive(tmp_path / "run.zip", tmp_path / "elsewhere")
    place = tmp_path / "elsewhere" / "run"
    for file in place.rglob("*"):
        os.utime(file, (5, 5))  # as rsync without times leaves them
    assert run(place / "movie.npy", place / "out", known(pixel_size_pm=8.0)) == (set(), [])
    assert run(place / "movie.npy", place / "out", WIDER) == ({"fit"}, [])
    assert store_metadata.attributes(place / "out" / "movie.zarr")["source"] == str(place / "movie.npy")


def test_a_source_of_another_name_and_time_is_known_by_what_it_holds(folder):
    (folder / "archive").mkdir()
    (folder / "movie.npy").rename(folder / "archive" / "m1.npy")
    os.utime(folder / "archive" / "m1.npy")
    assert run(folder / "archive" / "m1.npy", folder / "out", known(pixel_size_pm=8.0)) == (set(), [])


def test_a_name_that_never_was_there_is_no_source(folder):
    (folder / "movie.npy").unlink()
    with pytest.raises(SourceError, match="no such file"):
        run(folder / "other.npy", folder / "out", known())


def test_a_source_that_is_there_but_cannot_be_read_is_told(folder):
    os.truncate(folder / "movie.npy", 20)
    with pytest.raises(SourceError):
        run(folder / "movie.npy", folder / "out", known())


@pytest.mark.parametrize("pattern", ["frames", "frames/*.tif"])
def test_a_sequence_that_has_gone_is_not_asked_for(tmp_path, pattern):
    sequence(tmp_path / "frames", Scene().counts())
    run(f"{tmp_path}/{pattern}", tmp_path / "out", known(), until="convert")
    for file in (tmp_path / "frames").iterdir():
        file.unlink()
    worked, warnings = run(f"{tmp_path}/{pattern}", tmp_path / "out", known(), until="convert")
    assert (worked, len(warnings)) == (set(), 1)


def test_pixels_of_a_source_that_has_gone_are_asked_for_before_anything_is_deleted(folder):
    (folder / "movie.npy").unlink()
    for more in ({"overwrite": True}, {}):
        with pytest.raises((SourceError, DestinationError)):
            run(folder / "movie.npy", folder / "out", known(convert=ConvertSettings(codec="zstd")), **more)
    assert run(folder / "movie.npy", folder / "out", known(pixel_size_pm=8.0))[0] == set()


def test_an_unfinished_conversion_asks_for_its_source(tmp_path):
    path = tmp_path / "movie.npy"
    np.save(path, FRAMES)
    with pytest.raises(Interrupted):
        convert(path, tmp_path / "out" / "movie.zarr", settings=SMALL, on_event=after(3, interrupt))
    path.unlink()
    with pytest.raises(SourceError, match="no such file"):
        one_stage.run_convert(path, tmp_path / "out" / "movie.zarr", known())


# What is thrown away only when told


def test_a_complete_movie_is_thrown_away_only_when_told_and_what_differs_is_said(folder):
    path, settings = folder / "movie.npy", known(convert=ConvertSettings(shard_mb=1, codec="zstd", tile_px=32))
    with pytest.raises(DestinationError, match="converted otherwise") as caught:
        run(path, folder / "out", settings)
    assert caught.value.got == "convert.codec was lz4, and is zstd; convert.tile_px was 256, and is 32"
    for part in ("--overwrite", "12 frames of 160 x 144 px", "drift, sum and tracks"):
        assert part in caught.value.remedy
    with pytest.raises(DestinationError, match="converted otherwise"):
        one_stage.run_convert(path, folder / "out" / "movie.zarr", settings)
    assert run(path, folder / "out", known(pixel_size_pm=8.0)) == (set(), [])
    assert run(path, folder / "out", settings, overwrite=True)[0] == set(STAGES)


def test_settings_that_change_nothing_throw_nothing_away(folder):
    """A short movie's shards are an eighth of it, whatever is asked for."""
    changed = known(convert=ConvertSettings(shard_mb=2), pixel_size_pm=8.0)
    assert run(folder / "movie.npy", folder / "out", changed) == (set(), [])


def test_a_source_that_was_written_anew_is_another_movie(folder):
    np.save(folder / "movie.npy", Scene(seed=4).counts())
    with pytest.raises(DestinationError, match="the run of another movie"):
        run(folder / "movie.npy", folder / "out", known())
    with pytest.raises(DestinationError, match="made from something else"):
        convert(folder / "movie.npy", folder / "out" / "movie.zarr", settings=SMALL)


def test_another_declared_shape_is_named(tmp_path):
    FRAMES.tofile(tmp_path / "movie.raw")
    declared = SourceSettings(raw_shape=(24, 96, 80), raw_dtype="uint16")
    convert(tmp_path / "movie.raw", tmp_path / "m.zarr", settings=SMALL, source_settings=declared)
    other = SourceSettings(raw_shape=(24, 80, 96), raw_dtype="uint16")
    with pytest.raises(DestinationError, match=r"source\.raw_shape was"):
        convert(tmp_path / "movie.raw", tmp_path / "m.zarr", settings=SMALL, source_settings=other)


def test_a_movie_of_an_earlier_algorithm_is_made_again_only_when_told(folder, monkeypatch):
    monkeypatch.setitem(keys.ALGORITHMS, "convert", 99)
    with pytest.raises(DestinationError, match=r"number was \d, and is 99"):
        run(folder / "movie.npy", folder / "out", known())


@pytest.mark.parametrize("stage", ["drift", "sum", "columns", "fit"])
def test_a_stage_whose_algorithm_changed_is_made_again(folder, monkeypatch, stage):
    monkeypatch.setitem(keys.ALGORITHMS, stage, 99)
    assert stage in run(folder / "movie.npy", folder / "out", known(pixel_size_pm=8.0))[0]


def test_a_new_version_of_the_package_makes_nothing_again(folder, monkeypatch):
    monkeypatch.setattr(provenance.importlib.metadata, "version", lambda name: "9.9.9")
    assert run(folder / "movie.npy", folder / "out", known(pixel_size_pm=8.0)) == (set(), [])


def test_a_fit_that_an_earlier_algorithm_began_is_not_gone_on_with(folder, monkeypatch):
    from tract_dask.stages.fit import stage as fit_stage

    store_files.remove(folder / "out" / "results.zarr")
    measure, seen = fit_stage.measure, []

    def stop(*arguments):
        seen.append(arguments)
        if len(seen) == 3:
            raise Interrupted
        return measure(*arguments)

    monkeypatch.setattr(fit_stage, "measure", stop)
    with pytest.raises(Interrupted):
        run(folder / "movie.npy", folder / "out", known(pixel_size_pm=8.0))
    monkeypatch.setitem(keys.ALGORITHMS, "fit", 99)
    seen.append(None)
    run(folder / "movie.npy", folder / "out", known(pixel_size_pm=8.0))
    assert len(seen) == 3 + 1 + len(open_movie(folder / "out" / "movie.zarr").shards)


def test_drift_and_columns_files_count_by_what_they_hold(folder):
    (folder / "in").mkdir()
    drift = folder / "in" / "drift.csv"
    drift.write_text("frame,y,x\n" + "".join(f"{k},0,0\n" for k in range(12)))
    settings = known(pixel_size_pm=8.0)
    given = dataclasses.replace(settings, drift=dataclasses.replace(settings.drift, method="csv", csv=str(drift)))
    run(folder / "movie.npy", folder / "out", given)
    moved = drift.rename(folder / "moved.csv")
    again = dataclasses.replace(given, drift=dataclasses.replace(given.drift, csv=str(moved)))
    assert run(folder / "movie.npy", folder / "out", again) == (set(), [])
    unused = dataclasses.replace(settings, drift=dataclasses.replace(settings.drift, csv=str(moved)))
    run(folder / "movie.npy", folder / "out", settings)
    assert run(folder / "movie.npy", folder / "out", unused) == (set(), [])
    assert counted("drift", drift=unused.drift) == {}
