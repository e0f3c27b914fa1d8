"""Every file behind an HDF5 movie is found, asked for, and missed where it is not there."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from tract_dask.errors import InputError, SourceError
from tract_dask.readers import open_cached, open_source

FRAMES = np.random.default_rng(0).integers(1, 200, (6, 20, 24)).astype("u2")


class RefusedError(InputError):
    """What a permit raises."""


def only(folder: Path) -> Callable[[Path], None]:
    def permit(path: Path) -> None:
        assert path == path.resolve()
        if not path.is_relative_to(folder.resolve()):
            raise RefusedError("outside", str(path))

    return permit


def write(path: Path, name: str = "data", frames: np.ndarray = FRAMES) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "a") as file:
        file[name] = frames
    return path


def external(path: Path, target: Path | str, inner: str, name: str = "data") -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "a") as file:
        file[name] = h5py.ExternalLink(str(target), inner)
    return path


def virtual(path: Path, *targets: tuple[Path | str, str], maxshape: tuple[int | None, ...] | None = None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    step = len(FRAMES) // len(targets)
    layout = h5py.VirtualLayout(FRAMES.shape, "u2", maxshape)
    for k, (target, inner) in enumerate(targets):
        layout[step * k : step * (k + 1)] = h5py.VirtualSource(str(target), inner, (step, *FRAMES.shape[1:]))
    with h5py.File(path, "a") as file:
        file.create_virtual_dataset("data", layout)
    return path


def raw(path: Path, target: str, offset: int = 0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with h5py.File(path, "a") as file:
        file.create_dataset("data", FRAMES.shape, "u2", external=[(target, offset, FRAMES.nbytes)])
    return path


def pixels(path: Path, offset: int = 0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(bytes(offset) + FRAMES.tobytes())
    return path


def direct(root: Path, away: Path) -> tuple[str, set[Path]]:
    target = write(away / "part.h5", "entry/data")
    return f"{external(root / 'a.h5', target, '/entry/data')}::data", {target}


def beside(root: Path, away: Path) -> tuple[str, set[Path]]:
    """The relative name of a target holds in the folder of the file with the link, which is a link itself."""
    target = write(away / "part.h5")
    external(away / "a.h5", "part.h5", "data")
    (root / "a.h5").symlink_to(away / "a.h5")
    return f"{root / 'a.h5'}::/data", {target, away / "a.h5"}


def upwards(root: Path, away: Path) -> tuple[str, set[Path]]:
    target = write(away / "part.h5")
    return str(external(root / "a.h5", f"../{away.name}/part.h5", "data")), {target}


def through_soft_links(root: Path, away: Path) -> tuple[str, set[Path]]:
    target = write(away / "part.h5", "deep/data")
    path = external(root / "a.h5", target, "deep", "hidden/door")
    with h5py.File(path, "a") as file:
        file["first"] = h5py.SoftLink("hidden/second")
        file["hidden/second"] = h5py.SoftLink("door")
    return f"{path}::/first/data", {target}


def inside_a_target(root: Path, away: Path) -> tuple[str, set[Path]]:
    target = write(away / "part.h5")
    middle = external(root / "middle.h5", target, "data", "x/y")
    return f"{external(root / 'a.h5', middle.name, 'x')}::data/y", {target, middle}


def virtual_source(root: Path, away: Path) -> tuple[str, set[Path]]:
    near = write(root / "near.h5", frames=FRAMES[:3])
    target = write(away / "part.h5", frames=FRAMES[3:])
    return str(virtual(root / "a.h5", ("near.h5", "data"), (target, "data"))), {near, target}


def link_inside_a_virtual_source(root: Path, away: Path) -> tuple[str, set[Path]]:
    target = write(away / "part.h5")
    middle = external(root / "middle.h5", target, "data", "there")
    return str(virtual(root / "a.h5", (middle, "there"))), {middle, target}


def virtual_on_virtual(root: Path, away: Path) -> tuple[str, set[Path]]:
    target = write(away / "part.h5")
    middle = virtual(root / "middle.h5", (target, "data"))
    return str(virtual(root / "a.h5", (middle, "data"))), {middle, target}


def raw_storage(root: Path, away: Path) -> tuple[str, set[Path]]:
    target = pixels(away / "pixels.bin", 12)
    return str(raw(root / "a.h5", str(target), 12)), {target}


def raw_storage_beside(root: Path, away: Path) -> tuple[str, set[Path]]:
    target = pixels(away / "pixels.bin")
    return str(raw(root / "a.h5", f"../{away.name}/pixels.bin")), {target}


def raw_storage_of_a_virtual_source(root: Path, away: Path) -> tuple[str, set[Path]]:
    target = pixels(away / "pixels.bin")
    middle = raw(root / "middle.h5", str(target))
    return str(virtual(root / "a.h5", (middle, "data"))), {middle, target}


KINDS = [direct, beside, upwards, through_soft_links, inside_a_target, virtual_source, link_inside_a_virtual_source]
KINDS += [virtual_on_virtual, raw_storage, raw_storage_beside, raw_storage_of_a_virtual_source]
every_kind = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)


@every_kind
def test_all_files_behind_a_movie_are_found_and_asked_for(kind: Callable, tmp_path: Path) -> None:
    (tmp_path / "root").mkdir()
    name, behind = kind(tmp_path / "root", tmp_path / "away")
    asked: list[Path] = []
    source = open_source(name, permit=asked.append)
    np.testing.assert_array_equal(source.read(0, 6), FRAMES)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(open_source(name))).read(2, 5), FRAMES[2:5])
    assert {file.resolve() for file in source.files} == {Path(name.partition("::")[0]).resolve()} | behind
    assert {file.resolve() for file in source.files} <= set(asked)


@every_kind
def test_a_permit_that_refuses_keeps_the_file_shut(
    kind: Callable, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "root").mkdir()
    name, behind = kind(tmp_path / "root", tmp_path / "away")
    opened: list[Path] = []
    original = h5py.File

    def watched(path: Path, mode: str = "r") -> h5py.File:
        opened.append(Path(path).resolve())
        return original(path, mode)

    monkeypatch.setattr(h5py, "File", watched)
    for opener in (open_source, open_cached):
        with pytest.raises(RefusedError, match="outside"):
            opener(name, permit=only(tmp_path / "root"))
    assert not any(path.is_relative_to(tmp_path / "away") for path in opened), behind


@every_kind
def test_a_missing_file_is_named(kind: Callable, tmp_path: Path) -> None:
    (tmp_path / "root").mkdir()
    name, behind = kind(tmp_path / "root", tmp_path / "away")
    source = open_source(name)
    gone = next(file for file in behind if file.name in ("part.h5", "pixels.bin"))
    gone.rename(gone.with_name("elsewhere"))
    for attempt in (lambda: open_source(name), lambda: source.read(3, 6)):
        with pytest.raises(SourceError, match=gone.name):
            attempt()


@pytest.mark.parametrize("variable", ["HDF5_EXT_PREFIX", "HDF5_VDS_PREFIX"])
def test_prefixes_of_the_environment_open_no_hole(
    variable: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = tmp_path / "root"
    write(root / "part.h5")
    write(tmp_path / "away/part.h5", frames=FRAMES[::-1])
    make = {"HDF5_EXT_PREFIX": external, "HDF5_VDS_PREFIX": lambda path, *pair: virtual(path, pair)}[variable]
    path = make(root / "a.h5", "part.h5", "data")
    np.testing.assert_array_equal(open_source(path, permit=only(root)).read(0, 6), FRAMES)
    monkeypatch.setenv(variable, str(tmp_path / "away"))
    np.testing.assert_array_equal(open_source(path).read(0, 6), FRAMES[::-1])
    with pytest.raises(RefusedError):
        open_source(path, permit=only(root))


def test_what_lies_in_the_working_folder_is_asked_for(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path / "away/part.h5")
    monkeypatch.chdir(tmp_path / "away")
    for path in (
        external(tmp_path / "root/a.h5", "part.h5", "data"),
        virtual(tmp_path / "root/b.h5", ("part.h5", "data")),
        virtual(tmp_path / "root/c.h5", ("/not/here/part.h5", "data")),
    ):
        with pytest.raises(RefusedError):
            open_source(path, permit=only(tmp_path / "root"))


def test_the_movie_is_found_behind_a_link_and_others_may_be_lost(tmp_path: Path) -> None:
    write(tmp_path / "part.h5", "entry/data")
    path = external(tmp_path / "a.h5", "part.h5", "/entry/data", "entry/data_1")
    external(path, "gone.h5", "/entry/data", "entry/data_2")
    source = open_source(path)
    np.testing.assert_array_equal(source.read(0, 6), FRAMES)
    (note,) = source.metadata.notes
    assert "/entry/data_2 leads to gone.h5, which is not there" in note
    with pytest.raises(SourceError, match=r"gone\.h5"):
        open_source(f"{path}::/entry/data_2")
    write(path, "entry/data", np.full_like(FRAMES, 5))
    np.testing.assert_array_equal(open_source(f"{path}::/entry/data_1").read(0, 6), FRAMES)
    with pytest.raises(SourceError, match="2 data sets"):
        open_source(path)


def test_circles_of_links(tmp_path: Path) -> None:
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["one"], file["two"] = h5py.SoftLink("/two"), h5py.SoftLink("/one")
        file["out"] = h5py.ExternalLink("a.h5", "/out")
        group = file.create_group("group")
        group["above"] = file["/"]
        group["data"] = FRAMES
    for name in ("one", "out", "two/x"):
        with pytest.raises(SourceError, match="in a circle"):
            open_source(f"{path}::{name}")
    with pytest.raises(SourceError, match="in a circle"):
        open_source(path)
    with h5py.File(path, "a") as file:
        del file["out"]
    np.testing.assert_array_equal(open_source(path).read(0, 6), FRAMES)
    virtual(tmp_path / "v.h5", ("v.h5", "data"))
    open_source(virtual(tmp_path / "w.h5", (path, "group/above/group/data")))


def test_a_virtual_source_that_is_too_short(tmp_path: Path) -> None:
    write(tmp_path / "part.h5", frames=FRAMES[:4])
    with pytest.raises(SourceError, match=r"too short.*part\.h5.*at least 6 x 20 x 24.*4 x 20 x 24"):
        open_source(virtual(tmp_path / "a.h5", ("part.h5", "data")))


def test_numbered_virtual_sources(tmp_path: Path) -> None:
    """Names with %b are those of all blocks of frames that are there, as detectors write them."""
    for k in range(3):
        write(tmp_path / f"part_{k}.h5", frames=FRAMES[2 * k : 2 * k + 2])
    space = h5py.h5s.create_simple(FRAMES.shape, (h5py.h5s.UNLIMITED, *FRAMES.shape[1:]))
    unlimited, block = h5py.h5s.UNLIMITED, (2, *FRAMES.shape[1:])
    space.select_hyperslab((0, 0, 0), (unlimited, 1, 1), block, block)
    properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    properties.set_virtual(space, b"part_%b.h5", b"data", h5py.h5s.create_simple(block))
    with h5py.File(tmp_path / "a.h5", "w", libver="latest") as file:
        h5py.h5d.create(file.id, b"data", h5py.h5t.NATIVE_UINT16, space, properties)
    source = open_source(tmp_path / "a.h5")
    assert [file.name for file in source.files] == ["a.h5", "part_0.h5", "part_1.h5", "part_2.h5"]
    np.testing.assert_array_equal(source.read(0, source.shape[0]), FRAMES)


def test_raw_pixels_in_several_files_and_of_another_byte_order(tmp_path: Path) -> None:
    frames, cut = FRAMES.astype(">u2"), 1234
    (tmp_path / "one.bin").write_bytes(b"head" + frames.tobytes()[:cut])
    (tmp_path / "two.bin").write_bytes(frames.tobytes()[cut:])
    with h5py.File(tmp_path / "a.h5", "w") as file:
        places = [("one.bin", 4, cut), ("two.bin", 0, h5py.h5f.UNLIMITED)]
        file.create_dataset("data", FRAMES.shape, ">u2", external=places)
    source = open_source(tmp_path / "a.h5")
    for start in range(6):
        np.testing.assert_array_equal(source.read(start, start + 2), FRAMES[start : start + 2])
    (tmp_path / "two.bin").write_bytes(frames.tobytes()[cut:-1])
    for attempt in (lambda: source.read(5, 6), lambda: open_source(tmp_path / "a.h5")):
        with pytest.raises(SourceError, match="the file ends before"):
            attempt()


def test_frames_that_were_never_written_are_noted(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        dataset = file.create_dataset("data", (100, *FRAMES.shape[1:]), "u2", chunks=(1, *FRAMES.shape[1:]))
        dataset[:6] = FRAMES
        file.create_dataset("none", (100, 20, 24), "u2", chunks=(1, 20, 24))
        file.create_dataset("nothing", (100, 20, 24), "u2")
    assert "94 of 100 chunks were never written" in open_source(f"{tmp_path / 'a.h5'}::data").metadata.notes[0]
    for name in ("none", "nothing"):
        with pytest.raises(SourceError, match="no pixel of the data set was ever written"):
            open_source(f"{tmp_path / 'a.h5'}::{name}")


def test_no_link_is_followed_for_a_unit(tmp_path: Path) -> None:
    write(tmp_path / "a.h5", "signal/data")
    with h5py.File(tmp_path / "away.h5", "w") as file:
        file.create_group("axis").attrs.update({"scale": 0.5, "units": "s"})
    with h5py.File(tmp_path / "a.h5", "a") as file:
        file["signal/axis-0"] = h5py.ExternalLink("away.h5", "/axis")
    assert open_source(tmp_path / "a.h5").metadata.frame_time_s is None
