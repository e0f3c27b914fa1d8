"""What is at a path may be no file, or no longer what it was: each is a clear error at once."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np
import pytest
import tifffile
from files_classic import eer
from files_dm import write_dm
from files_hdf5 import small_zarr
from files_stamped import write_mib, write_seq, write_ser, write_tvips
from files_video import write_video

from tract_dask.errors import InputError, SourceError
from tract_dask.readers import READERS, open_cached, open_source
from tract_dask.settings import SourceSettings

FRAMES = np.random.default_rng(0).integers(0, 200, (4, 20, 24)).astype("u2")
EVENTS = np.random.default_rng(2).random((160, 20, 24)) < 0.1
FRAMES_OF = {".eer": EVENTS.reshape(4, 40, 20, 24).sum(1, dtype="u1")}
"""What those formats give that cannot hold FRAMES."""

DECLARED = SourceSettings(raw_shape=(0, 20, 24), raw_dtype="uint16")
BESIDE = {".emi", ".hdr"}
"""Suffixes of files whose frames lie in another one."""

KINDS = pytest.mark.parametrize("suffix", sorted(set(READERS) - BESIDE))


def fails(path: Path | str, *words: str) -> None:
    with pytest.raises(SourceError) as caught:
        open_source(path, DECLARED)
    text = str(caught.value)
    assert all(word in text for word in words), text
    assert caught.value.remedy


def write(path: Path) -> Path:
    suffix = path.suffix
    if suffix in (".tif", ".tiff", ".stk"):
        tifffile.imwrite(path, FRAMES, photometric="minisblack", compression="zlib" if suffix == ".tiff" else None)
    elif suffix == ".eer":
        eer(path, EVENTS)
    elif suffix == ".npy":
        np.save(path, FRAMES)
    elif suffix in (".avi", ".mp4", ".mov"):
        write_video(path, FRAMES.astype("u1"), "png")
    elif suffix in (".h5", ".hdf5", ".hspy", ".emd", ".nxs"):
        with h5py.File(path, "w") as file:
            file["data"] = FRAMES
    elif suffix in (".zarr", ".zspy"):
        small_zarr(path, FRAMES)
    elif suffix in (".mrc", ".mrcs", ".st", ".map", ".rec", ".ali"):
        header = np.zeros(256, "<i4")
        header[:4] = *FRAMES.shape[::-1], 6
        path.write_bytes(header.tobytes() + FRAMES.tobytes())
    elif suffix in (".ser", ".tvips", ".seq", ".mib"):
        {".ser": write_ser, ".tvips": write_tvips, ".seq": write_seq, ".mib": write_mib}[suffix](path, FRAMES)
    elif suffix in (".dm3", ".dm4", ".dm5"):
        write_dm(path, FRAMES)
    else:
        path.write_bytes(FRAMES.tobytes())
    return path


@KINDS
def test_pipes_sockets_devices_folders_and_empty_files(suffix: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / f"pipe{suffix}")
    fails(tmp_path / f"pipe{suffix}", "this is not a file", "a pipe")
    place = tmp_path / f"socket{suffix}"
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(os.path.relpath(place))
        fails(place, "this is not a file", "a socket")
    (tmp_path / f"device{suffix}").symlink_to("/dev/zero")
    fails(tmp_path / f"device{suffix}", "this is not a file", "a device")
    (tmp_path / f"empty{suffix}").touch()
    fails(tmp_path / f"empty{suffix}", "the file is empty")
    (tmp_path / f"folder{suffix}").mkdir()
    fails(tmp_path / f"folder{suffix}", "no frames")


@KINDS
def test_links_that_lead_nowhere(suffix: str, tmp_path: Path) -> None:
    (tmp_path / f"one{suffix}").symlink_to(f"two{suffix}")
    fails(tmp_path / f"one{suffix}", f"the link leads to two{suffix}, which is not there")
    (tmp_path / f"two{suffix}").symlink_to(f"one{suffix}")
    fails(tmp_path / f"one{suffix}", "cannot be opened", "Too many levels of symbolic links")
    fails(tmp_path / f"none{suffix}", "no such file")
    fails(tmp_path / f"none{suffix}/below", "no such file")


def test_a_folder_with_a_pipe_among_its_frames(tmp_path: Path) -> None:
    write(tmp_path / "f_1.npy")
    os.mkfifo(tmp_path / "f_2.npy")
    for name in (tmp_path, tmp_path / "f_*.npy", [tmp_path / "f_1.npy", tmp_path / "f_2.npy"]):
        fails(name, "f_2.npy", "a pipe")


@pytest.mark.parametrize("link", [h5py.ExternalLink("pipe", "/data"), None])
def test_a_pipe_behind_an_hdf5_file(link: h5py.ExternalLink | None, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        if link:
            file["data"] = link
        else:
            file.create_dataset("data", FRAMES.shape, "u2", external=[("pipe", 0, FRAMES.nbytes)])
    fails(tmp_path / "a.h5", "pipe", "this is not a file")


@KINDS
def test_no_permission(suffix: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Root may read all; so the system's calls are made to refuse."""
    path = write(tmp_path / f"movie{suffix}")
    real = Path.stat

    def refuse(self: Path, *, follow_symlinks: bool = True) -> os.stat_result:
        if self == path:
            raise PermissionError(13, "Permission denied", str(path))
        return real(self, follow_symlinks=follow_symlinks)

    monkeypatch.setattr(Path, "stat", refuse)
    fails(path, "cannot be read", "Permission denied", "permissions")


@KINDS
@pytest.mark.parametrize("name", ["a::b", "::", "run [2] *?", "r\udcff\udc80", "µ Å 原子", "a::/b"])
def test_names_that_look_like_something_else(name: str, suffix: str, tmp_path: Path) -> None:
    folder = tmp_path / name
    folder.mkdir(parents=True)
    path = write(folder / f"{Path(name).name}{suffix}")
    write(tmp_path / f"stranger{suffix}")
    frames = FRAMES_OF.get(suffix, FRAMES)
    for place in (path, folder, f"{folder}/*{suffix}"):
        source = open_source(place, DECLARED)
        assert source.files == (path,)
        np.testing.assert_array_equal(source.read(0, 4), frames)
        np.testing.assert_array_equal(open_cached(str(place), DECLARED).read(1, 3), frames[1:3])
    if suffix in (".h5", ".hspy"):
        np.testing.assert_array_equal(open_source(f"{path}::/data").read(0, 4), FRAMES)


def test_only_the_last_part_may_be_a_pattern(tmp_path: Path) -> None:
    for folder in ("scan 2", "scan [2]"):
        (tmp_path / folder).mkdir()
    np.save(tmp_path / "scan 2/f_1.npy", FRAMES)
    np.save(tmp_path / "scan [2]/f_1.npy", FRAMES[::-1])
    np.testing.assert_array_equal(open_source(tmp_path / "scan [2]/f_*.npy").read(0, 4), FRAMES[::-1])
    np.save(tmp_path / "scan 2/f_[1].npy", FRAMES + 1)
    np.testing.assert_array_equal(open_source(tmp_path / "scan 2/f_[1].npy").read(0, 4), FRAMES + 1)
    for pattern in ("scan ?/f_1.npy", "*/f_1.npy", "**/f_*.npy"):
        fails(tmp_path / pattern, "there is no such folder", "Name the folder without")
    fails(tmp_path / "gone/f_*.npy", "no such file")
    fails(tmp_path / "scan 2/g_*.npy", "no frames", "pattern")


def test_a_list_of_files_is_one_movie_in_its_order(tmp_path: Path) -> None:
    for k in range(3):
        np.save(tmp_path / f"f_{k}.npy", FRAMES[k : k + 1])
    names = [tmp_path / "f_2.npy", str(tmp_path / "f_0.npy"), tmp_path / "f_1.npy"]
    asked: list[Path] = []
    source = open_source(names, permit=asked.append)
    np.testing.assert_array_equal(source.read(0, 3), FRAMES[[2, 0, 1]])
    assert [file.name for file in source.files] == ["f_2.npy", "f_0.npy", "f_1.npy"]
    assert source.path == str(names[0])
    assert set(map(Path, names)) == set(asked)
    np.testing.assert_array_equal(open_cached(tuple(names)).read(0, 3), FRAMES[[2, 0, 1]])
    np.save(tmp_path / "g.npy", FRAMES[:, :5])
    for wrong, words in (
        ([], "no frames"),
        ([*names, tmp_path / "g.npy"], "differs"),
        ([*names, "none.npy"], "no such"),
    ):
        fails(wrong, words)
    for k in (0, 1):
        write(tmp_path / f"h_{k}.h5")
    both = [f"{tmp_path}/h_{k}.h5::/data" for k in (0, 1)]
    assert open_source(both).shape == (8, 20, 24)
    fails([both[0], f"{tmp_path}/h_1.h5"], "different paths inside")


@contextmanager
def writer(path: Path, *, swmr: bool) -> Iterator[None]:
    """Another process that holds the file open for writing."""
    lines = ["import h5py, sys", "file = h5py.File(sys.argv[1], 'a', libver='latest')"]
    lines += ["file.swmr_mode = True"] * swmr + ["print('ready', flush=True)", "sys.stdin.read()", "file.close()"]
    command = [sys.executable, "-c", "\n".join(lines), str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline()
        try:
            yield
        finally:
            process.communicate(b"")


@pytest.mark.parametrize("swmr", [False, True])
def test_a_file_that_its_writer_has_locked(swmr: bool, tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w", libver="latest") as file:
        file.create_dataset("data", data=FRAMES, chunks=(1, 20, 24), maxshape=(None, 20, 24))
    source = open_source(path)
    with writer(path, swmr=swmr):
        for attempt in (lambda: open_source(path), lambda: source.read(0, 1)):
            with pytest.raises(SourceError, match=r"another program (has locked|is writing) the file.*Wait until"):
                attempt()
    np.testing.assert_array_equal(open_source(path).read(0, 4), FRAMES)


@KINDS
def test_a_file_that_shrinks_or_goes(suffix: str, tmp_path: Path) -> None:
    path = write(tmp_path / f"movie{suffix}")
    source = open_source(path, DECLARED)
    whole = path.read_bytes()
    for kept in (len(whole) // 2, 100, 0):
        path.write_bytes(whole[:kept])
        with pytest.raises(InputError, match=path.name):
            source.read(0, 4)
    path.unlink()
    for attempt in (lambda: source.read(0, 4), lambda: source.read_into(0, np.empty((4, 20, 24), "u2"))):
        with pytest.raises(SourceError, match=r"(?i)no such file"):
            attempt()


def test_a_fortran_file_that_shrinks(tmp_path: Path) -> None:
    path = tmp_path / "movie.npy"
    np.save(path, np.asfortranarray(FRAMES))
    source = open_source(path)
    os.truncate(path, 200)
    with pytest.raises(SourceError, match="the file ends before the frames"):
        source.read(0, 4)


@pytest.mark.parametrize("number", [5, 13, 116], ids=["EIO", "EACCES", "ESTALE"])
def test_the_systems_own_error_stays_the_cause(number: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever tries again has to know a passing error of a disk from a damaged file."""
    path = write(tmp_path / "a.h5")
    source = open_source(path)

    def broken(*arguments: object) -> None:
        raise OSError(f"Unable to synchronously open file (file read failed: errno = {number}, error message = 'x')")

    monkeypatch.setattr(h5py, "File", broken)
    for attempt in (lambda: open_source(path), lambda: source.read(0, 1)):
        with pytest.raises(SourceError, match="Check that it is there, its permissions") as caught:
            attempt()
        assert isinstance(caught.value.__cause__, OSError)
        assert caught.value.__cause__.errno == number


def in_time(work: Callable[[], object], seconds: float = 20) -> object:
    """Return what may not wait for anything, its error included; the rest of the tests goes on where it does."""
    found: list[object] = []

    def run() -> None:
        try:
            found.append(work())
        except Exception as error:  # noqa: BLE001 - the test looks at it
            found.append(error)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    thread.join(seconds)
    assert found, "it waits forever"
    return found[0]


@KINDS
def test_a_pipe_in_place_of_a_movie_that_is_open(suffix: str, tmp_path: Path) -> None:
    path = write(tmp_path / f"movie{suffix}")
    source = open_source(path, DECLARED)
    for file in source.files:
        file.unlink()
        os.mkfifo(file)
    said = in_time(lambda: source.read(0, 1))
    assert isinstance(said, SourceError)
    assert "a pipe" in str(said)


BESIDE_MOVIES = (
    *(".mdoc", "_info.txt", ".hdr", ".emi", ".dark.mrc", ".gain.mrc", ".metadata", ".xml", ".Config.Metadata.xml"),
    *("_1.ser", "_001.tvips", "_master.h5", "_data_000001.h5", ".gain"),
)


@KINDS
def test_pipes_beside_a_movie(suffix: str, tmp_path: Path) -> None:
    """A pipe may have any name that a file beside a movie can have; it holds nothing that a movie lacks."""
    path = write(tmp_path / f"movie_000{suffix}")
    there = {os.path.realpath(path)}
    for stem in ("movie_000", "movie", path.name):
        for end in BESIDE_MOVIES:
            place = tmp_path / f"{stem}{end}"
            if os.path.realpath(place) not in there and not (suffix == ".tvips" and end == "_001.tvips"):
                os.mkfifo(place)
    assert in_time(lambda: open_source(path, DECLARED).shape) == (4, 20, 24)


def test_a_pipe_as_a_later_part(tmp_path: Path) -> None:
    """A pipe at the end is no empty file, which a camera may leave there."""
    write_tvips(tmp_path / "m_000.tvips", FRAMES, per_file=2)
    first, second = sorted(tmp_path.iterdir())
    second.unlink()
    os.mkfifo(second)
    fails(first, second.name, "a pipe")
