"""Zarr and the file system: stores written whole and opened with checks, writing aside, checking destinations."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from threading import Lock
from typing import Any, Literal

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.storage import LocalStore

from . import disk
from .damage import CHECKED, METADATA, damaged, read_json, reading, unreadable
from .errors import DestinationError, MissingStoreError, StoreError, TractError
from .schema import texts
from .shard_files import CHUNK_KEYS, crc32c

ATTRIBUTE = "tract_dask"
"""Name of the attribute under which every store keeps its provenance and its own metadata."""

FORMAT = 2
"""Number of the format in which stores are written. In format 1 chunks had no checksums, and stores no number."""

_WRITE_ALL = {"array.write_empty_chunks": True}
"""Zarr's configuration in which every chunk is written: one that is missing is an error, never the fill value."""

_MARKS = ("frame_bad_pixels", "fit_ref", "quality", "exposure")
"""Arrays by which our stores are known where they do not say what they are."""


@contextmanager
def sole_parser() -> Iterator[None]:
    """Let no other thread of this process parse Python source in this block, nor compile with Numba.

    In CPython 3.11 (gh-106905) a thread that builds a syntax tree fails with "AST constructor recursion depth mismatch"
    where another one does so at the same time. Numba builds them under the lock that is held here; numpy builds one for
    the header of every .npy file that it reads.
    """
    from numba.core.compiler_lock import global_compiler_lock  # takes its time to import

    with global_compiler_lock:
        yield


def load_array(path: Path, mmap_mode: Literal["r"] | None = None) -> NDArray[Any]:
    """Return the array in a .npy file; safe where other threads of a worker read or compile."""
    with sole_parser():
        loaded: NDArray[Any] = np.load(path, mmap_mode=mmap_mode)
    return loaded


def open_array(path: Path) -> zarr.Array[Any]:
    """Return the Zarr array at ``path``, to be read; where its store is complete, a missing chunk is an error.

    Raises
    ------
    StoreError
        Where there is no array, or its metadata are damaged; when it is read, where a chunk is damaged or missing.
    """
    store, about = _store_around(path)
    _check_nodes(store, about, [path.relative_to(store).as_posix()])
    try:
        with _configured(CHECKED if _is_whole(about) else {}), _opening(path):
            return zarr.open_array(path, mode="r", zarr_format=3)
    except (FileNotFoundError, zarr.errors.NodeNotFoundError) as error:
        raise StoreError("there is no Zarr array here", str(path), remedy="Run the stage that writes it") from error


def attributes(path: Path) -> dict[str, Any]:
    """Return what the store at ``path`` says of itself under :data:`ATTRIBUTE`; empty where there is no such store.

    Raises
    ------
    StoreError
        Where it is damaged, or cannot be read.
    MissingStoreError
        Where a newer version of the package wrote it.
    """
    file = path / METADATA
    metadata = read_json(file)
    if not metadata and _is_marked(path):
        metadata = read_json(file)  # it may have been put there between the two looks
    found = metadata.get("attributes", {}).get(ATTRIBUTE)
    if not isinstance(found, dict):
        if _is_marked(path):
            raise damaged(file, "no metadata of tract_dask" if metadata else "no such file")
        return {}
    number, checksum = format_of(found), found.pop("checksum", None)
    if (checksum is not None or number != 1) and checksum != digest(metadata):
        raise damaged(file, "its checksum is that of other data: it was damaged, or changed by another program")
    if number > FORMAT:
        version = found.get("versions", {}).get("tract_dask", "unknown")
        raise MissingStoreError(
            "a newer version of tract_dask wrote this store",
            str(path),
            f"format {FORMAT} or older",
            f"format {number}, of version {version}",
            "Install that version or a newer one, or remove the store and make it anew",
        )
    return found


def _is_marked(path: Path) -> bool:
    """Tell whether a folder holds arrays of ours."""
    return any((path / name / METADATA).exists() for name in _MARKS)


def is_sound(path: Path) -> bool:
    """Tell whether the metadata of the store at ``path`` are as they were written; so they are where there is none.

    Raises
    ------
    StoreError
        Where they cannot be read, or a newer version of the package wrote them.
    """
    try:
        check_nodes(path, attributes(path))
    except StoreError as error:
        if isinstance(error, MissingStoreError) or is_of_system(error):
            raise
        return False
    return True


def is_of_system(error: StoreError) -> bool:
    """Tell whether the system did not give a file, which may be sound."""
    return isinstance(error.__cause__, OSError) and not isinstance(error.__cause__, FileNotFoundError)


def check_nodes(path: Path, about: Mapping[str, Any], changing: Collection[str] = ()) -> None:
    """Check that the metadata of all arrays and groups are those that were written.

    Parameters
    ----------
    about
        What the store at ``path`` says of itself.
    changing
        Nodes whose metadata may be others, since they are about to be written anew.

    Raises
    ------
    StoreError
        Where they are damaged or missing.
    """
    _check_nodes(path, about, [name for name in about.get("arrays", ()) if name not in changing])
    for name in changing:
        if not read_json(path / name / METADATA):
            raise damaged(path / name / METADATA, "no such file", "is missing")


def format_of(about: Mapping[str, Any]) -> int:
    """Return the number of a store's format, by its attributes; 1 for stores that have none."""
    number = about.get("format")
    return number if isinstance(number, int) else 1  # in format 1 it was that of a movie's source


def update_attributes(path: Path, *, plain: Mapping[str, Any] | None = None, **changes: Any) -> None:
    """Change what the store at ``path`` says of itself; written aside, then renamed.

    ``plain`` are attributes that stand beside :data:`ATTRIBUTE`, for other readers.
    """
    attributes(path)  # refuses one that is damaged
    metadata = read_json(path / METADATA)
    known = metadata.setdefault("attributes", {})
    known.update(plain or {})
    known.setdefault(ATTRIBUTE, {}).update(changes)
    write_root(path, metadata)


def write_root(path: Path, metadata: dict[str, Any], changed: Collection[str] = ()) -> None:
    """Write the root's metadata of a store, with the number of the format and checksums of all metadata.

    Parameters
    ----------
    changed
        Arrays whose metadata have changed since the root was last written; of all where that was never.
    """
    ours = metadata.setdefault("attributes", {}).setdefault(ATTRIBUTE, {})
    known = ours.get("arrays")
    names = _nodes(path) if known is None else changed
    ours["arrays"] = (known or {}) | {name: digest(read_json(path / name / METADATA)) for name in names}
    ours["format"] = FORMAT
    ours.pop("checksum", None)
    metadata = json_ready(metadata)
    ours = metadata["attributes"][ATTRIBUTE]
    ours["checksum"] = digest(metadata)
    write_aside(path / METADATA, json.dumps(metadata, indent=2).encode())


def seal(path: Path) -> None:
    """Give a new store the number of the format and checksums of the metadata of all its arrays."""
    metadata = read_json(path / METADATA)
    metadata.setdefault("attributes", {}).setdefault(ATTRIBUTE, {}).pop("arrays", None)
    write_root(path, metadata)


def nodes(store: Path) -> list[str]:
    """Return the names of the arrays and groups that a store holds, or should."""
    about = attributes(store)
    return list(about["arrays"] if "arrays" in about else _nodes(store))


def read_node(store: Path, name: str) -> dict[str, Any]:
    """Return the metadata of an array or group of a store, checked.

    Raises
    ------
    StoreError
        Where they are damaged or missing.
    """
    return _read_node(store, attributes(store), name)


def _nodes(path: Path, inside: str = "") -> Iterator[str]:
    """Yield the names of the arrays and groups inside a group, whatever their depth."""
    for folder in sorted((path / inside).iterdir()):
        if (about := read_json(folder / METADATA) if folder.is_dir() else {}) and not folder.name.startswith("."):
            name = f"{inside}{folder.name}"
            yield name
            if about.get("node_type") == "group":
                yield from _nodes(path, f"{name}/")


def digest(metadata: dict[str, Any]) -> int:
    """Return the CRC-32C of metadata, whatever their white space and the order of their names."""
    return crc32c(json.dumps(metadata, sort_keys=True, separators=(",", ":")).encode())


def _store_around(array: Path) -> tuple[Path, dict[str, Any]]:
    """Return the store that an array is part of, and what it says of itself; its folder and nothing for one alone."""
    for folder in list(array.parents)[:2]:
        if about := attributes(folder):
            return folder, about
    return array.parent, {}


def _check_nodes(store: Path, about: Mapping[str, Any], names: Iterable[str]) -> None:
    """Check that the metadata of arrays are those that were written."""
    for name in names:
        if name in about.get("arrays", ()):
            _read_node(store, about, name)


def _read_node(store: Path, about: Mapping[str, Any], name: str) -> dict[str, Any]:
    file, known = store / name / METADATA, about.get("arrays", {})
    found = read_json(file)
    if not found:
        raise damaged(file, "no such file", "is missing")
    if digest(found) != known.get(name, digest(found)):
        raise damaged(file, "its checksum is that of other data")
    return found


def _is_whole(about: Mapping[str, Any]) -> bool:
    """Tell whether every chunk of a store has to be there."""
    return format_of(about) >= FORMAT and bool(about.get("complete", True))


_configuring = Lock()


@contextmanager
def _configured(how: Mapping[str, Any]) -> Iterator[None]:
    """Let Zarr be configured so in this block, in one thread at a time: all threads have the same configuration."""
    with _configuring, zarr.config.set(how):
        yield


@contextmanager
def _opening(path: Path) -> Iterator[None]:
    """Turn what Zarr makes of metadata that it does not understand into a StoreError."""
    try:
        yield
    except (FileNotFoundError, zarr.errors.NodeNotFoundError, zarr.errors.GroupNotFoundError):
        raise
    except OSError as error:
        raise unreadable(path / METADATA, error) from error
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        raise damaged(path / METADATA, f"{type(error).__name__}: {error}") from error


def write_aside(path: Path, data: bytes) -> None:
    """Write a small file so that it is either whole or not there: beside its place first, synced, then renamed."""
    aside = path.with_name(f".{path.name}.{os.getpid()}.partial")
    with disk_errors(path):
        aside.write_bytes(data)
        disk.place_now(aside, path)


def write_dataset(dataset: xr.Dataset, path: Path) -> None:
    """Write a small Dataset as a Zarr store, whole or not at all."""
    aside = path.with_name(f".{path.name}.partial")
    with disk_errors(path):
        remove(aside)
        write_arrays(dataset, aside)
        seal(aside)
        remove(path)
        disk.place_folder(aside, path)


def write_arrays(dataset: xr.Dataset, path: Path) -> None:
    """Write a small Dataset as a new Zarr group: every chunk, each with its checksum; :func:`seal` it then."""
    words = {name: variable for name, variable in dataset.variables.items() if variable.dtype.kind == "U"}
    dataset = dataset.assign({name: (word.dims, texts(word.to_numpy()), word.attrs) for name, word in words.items()})
    how = {"compressors": (ZstdCodec(), Crc32cCodec()), "chunk_key_encoding": CHUNK_KEYS}
    dataset.to_zarr(
        LocalStore(path),
        mode="w",
        zarr_format=3,
        consolidated=False,
        write_empty_chunks=True,
        encoding=dict.fromkeys(map(str, dataset.variables), how),
    )


def overwrite_array(path: Path, values: NDArray[Any]) -> None:
    """Write all values of an array of a store anew."""
    with _configured(_WRITE_ALL):
        with _opening(path):
            array = zarr.open_array(path, mode="r+", zarr_format=3)
        array[...] = values


def open_dataset(path: Path, only: Collection[str] = ()) -> xr.Dataset:
    """Return the Dataset of a store, or only some of its variables, in memory; text as objects.

    Raises
    ------
    MissingStoreError
        Where there is none, or a variable is not in it.
    StoreError
        Where it is damaged, or a chunk of it is missing.
    """
    dataset = open_lazily(path, partial=False)
    if lacking := set(only) - set(map(str, dataset.variables)):
        raise MissingStoreError(
            "this store is of another kind or version",
            str(path),
            ", ".join(only),
            f"no {', '.join(sorted(lacking))}",
            "Remove it, and run the stage that writes it again",
        )
    with reading(path):
        dataset = (dataset[list(only)] if only else dataset).load()
    return dataset.assign(
        {name: word.astype(object) for name, word in dataset.data_vars.items() if word.dtype.kind == "T"}
    )


def open_lazily(path: Path, *, partial: bool = False) -> xr.Dataset:
    """Return the Dataset of a store, whose chunks are checked when they are read.

    Parameters
    ----------
    partial
        Take chunks that are missing as the fill value: those of frames that are not done.

    Raises
    ------
    MissingStoreError
        Where there is none.
    StoreError
        Where its metadata are damaged.
    """
    about = attributes(path)
    check_nodes(path, about)
    whole = format_of(about) >= FORMAT and not partial
    try:
        with _configured(CHECKED if whole else {}), _opening(path):
            opened: xr.Dataset = xr.open_zarr(LocalStore(path, read_only=True), consolidated=False, chunks=None)
    except (FileNotFoundError, zarr.errors.NodeNotFoundError, zarr.errors.GroupNotFoundError) as error:
        raise MissingStoreError("there is no Dataset here", str(path), remedy="Run the stage that writes it") from error
    return opened


def remove(path: Path) -> None:
    """Delete a store, a folder or a file, if it is there.

    A folder goes at once for everybody who looks, also where this process is killed meanwhile: renamed, then deleted.
    """
    if path.is_symlink() or (path.exists() and not path.is_dir()):
        path.unlink(missing_ok=True)
        return
    if not path.name.startswith("."):
        aside = path.with_name(f".{path.name}.removed")
        remove(aside)  # of a process that was killed
        with suppress(FileNotFoundError):
            path.replace(aside)
        path = aside
    with suppress(FileNotFoundError):
        shutil.rmtree(path)


def abandon(path: Path) -> None:
    """Say in a store that it is to be made anew, before it is deleted file by file: that may be interrupted."""
    with suppress(OSError, TractError):  # on a full disk, and in what is damaged already, it is deleted all the same
        if attributes(path).get("key"):
            update_attributes(path, complete=False, key="")


def check_destination(path: Path, *, overwrite: bool = False) -> None:
    """Check that a store can be made at ``path``: nothing there that is not ours, and the folder can be written.

    Raises
    ------
    DestinationError
        Where it holds something else, or cannot be written, or its name is not UTF-8, which codecs cannot open.
    """
    if any(0xD800 <= ord(sign) < 0xE000 for sign in str(path.absolute())):
        raise DestinationError(
            "the name of this place is not UTF-8",
            ascii(str(path.absolute())),
            "letters in UTF-8",
            remedy="Choose another place, or rename the folder",
        )
    if not overwrite:
        check_place(path)
    folder = path.parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / f".{path.name}.{os.getpid()}.probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise DestinationError(
            "this folder cannot be written",
            str(folder),
            "a folder that you may write to",
            f"a link to {folder.readlink()}, which is not there"
            if folder.is_symlink() and not folder.exists()
            else error.strerror or str(error),
            "Choose another place, or mend its permissions",
        ) from error


def check_place(path: Path) -> None:
    """Check that nothing lies at ``path``, or a store of ours.

    Raises
    ------
    DestinationError
        Where it is something else.
    """
    if path.exists() and not attributes(path) and not (path.is_dir() and not any(path.iterdir())):
        raise DestinationError(
            "this place holds something else",
            str(path),
            "nothing, or a store of tract_dask",
            "a folder" if path.is_dir() else "a file",
            "Choose another place, or say --overwrite",
        )


def check_free_space(path: Path, needed: int) -> None:
    """Check that the disk under ``path`` has ``needed`` bytes free.

    Raises
    ------
    DestinationError
        With both numbers.
    """
    free = shutil.disk_usage(next(p for p in (path, *path.absolute().parents) if p.exists())).free
    if free < needed:
        raise DestinationError(
            "the disk is too small for this",
            str(path),
            f"about {_readable(needed)} free",
            _readable(free),
            "Free some space, or choose another disk",
        )


def _readable(size: int) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.1f} MB"


@contextmanager
def disk_errors(path: Path) -> Iterator[None]:
    """Turn a full disk or a refused write inside this block into a StoreError; other errors of the system name it."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS):
            error.filename = error.filename or str(path)
            raise
        raise StoreError(
            "writing failed",
            str(path),
            got=os.strerror(error.errno),
            remedy="Free some space or mend the permissions, then run again: what is done is kept",
        ) from error


def json_ready(value: Any) -> Any:
    """Return numpy scalars and arrays inside ``value`` as plain Python, for JSON."""
    if isinstance(value, dict):
        return {key: json_ready(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [json_ready(item) for item in value]
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    return value
