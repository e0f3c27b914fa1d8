"""Zarr and the file system: stores written whole and opened with checks, writing aside, checking destinations."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any

import xarray as xr
import zarr
from numpy.typing import NDArray
from zarr.codecs import Crc32cCodec, ZstdCodec
from zarr.storage import LocalStore

from ..errors import MissingStoreError, StoreError
from . import disk
from .checked import CHECKED
from .damage import METADATA, damaged, reading, unreadable
from .files import disk_errors, remove
from .held import check_held
from .metadata import FORMAT, attributes, check_named, check_nodes, format_of, seal
from .schema import texts
from .shard_files import CHUNK_KEYS

_WRITE_ALL = {"array.write_empty_chunks": True}
"""Zarr's configuration in which every chunk is written: one that is missing is an error, never the fill value."""


def open_array(path: Path) -> zarr.Array[Any]:
    """Return the Zarr array at ``path``, to be read; where its store is complete, a missing chunk is an error.

    Raises
    ------
    StoreError
        Where there is no array, or its metadata are damaged; when it is read, where a chunk is damaged or missing.
    """
    store, about = _store_around(path)
    check_named(store, about, [path.relative_to(store).as_posix()])
    try:
        with _configured(CHECKED if _is_whole(about) else {}), _opening(path):
            return zarr.open_array(path, mode="r", zarr_format=3)
    except (FileNotFoundError, zarr.errors.NodeNotFoundError) as error:
        raise StoreError("there is no Zarr array here", str(path), remedy="Run the stage that writes it") from error


def _store_around(array: Path) -> tuple[Path, dict[str, Any]]:
    """Return the store that an array is part of, and what it says of itself; its folder and nothing for one alone."""
    for folder in list(array.parents)[:2]:
        if about := attributes(folder):
            return folder, about
    return array.parent, {}


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


def write_dataset(dataset: xr.Dataset, path: Path) -> None:
    """Write a small Dataset as a Zarr store, whole or not at all."""
    aside = disk.aside(path)
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
    check_held(path / METADATA)
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
