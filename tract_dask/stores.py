"""Zarr and the file system: opening arrays with the fast codec pipeline, writing aside, checking destinations."""

from __future__ import annotations

import errno
import json
import os
import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal

import numpy as np
import xarray as xr
import zarr
from numpy.typing import NDArray

from .errors import DestinationError, MissingStoreError, StoreError
from .schema import texts
from .small_files import read_small

ATTRIBUTE = "tract_dask"
"""Name of the attribute under which every store keeps its provenance and its own metadata."""

_METADATA_BYTES = 16 << 20


@contextmanager
def codec_pipeline() -> Iterator[None]:
    """Open arrays inside this block with the ``zarrs`` codec pipeline, where it is installed; it reads faster."""
    if find_spec("zarrs") is None:
        yield
        return
    with zarr.config.set({"codec_pipeline.path": "zarrs.ZarrsCodecPipeline"}):
        yield


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
    """Return the Zarr array at ``path``, to be read.

    Raises
    ------
    StoreError
        Where there is no array.
    """
    try:
        with codec_pipeline():
            return zarr.open_array(str(path), mode="r", zarr_format=3)
    except (FileNotFoundError, zarr.errors.NodeNotFoundError) as error:
        raise StoreError("there is no Zarr array here", str(path), remedy="Run the stage that writes it") from error


def attributes(path: Path) -> dict[str, Any]:
    """Return what the store at ``path`` says of itself under :data:`ATTRIBUTE`; empty where there is no such store."""
    try:
        metadata = json.loads(read_small(path / "zarr.json", _METADATA_BYTES))
    except (OSError, ValueError, RecursionError):
        return {}
    if not isinstance(metadata, dict) or not isinstance(metadata.get("attributes", {}), dict):
        return {}
    found = metadata.get("attributes", {}).get(ATTRIBUTE, {})
    return found if isinstance(found, dict) else {}


def update_attributes(path: Path, *, plain: Mapping[str, Any] | None = None, **changes: Any) -> None:
    """Change what the store at ``path`` says of itself; written aside, then renamed.

    ``plain`` are attributes that stand beside :data:`ATTRIBUTE`, for other readers.
    """
    file = path / "zarr.json"
    metadata = json.loads(file.read_text(encoding="utf-8"))
    attributes = metadata.setdefault("attributes", {})
    attributes.update(plain or {})
    attributes.setdefault(ATTRIBUTE, {}).update(changes)
    write_aside(file, json.dumps(metadata, indent=2).encode())


def write_aside(path: Path, data: bytes) -> None:
    """Write a small file so that it is either whole or not there: beside its place first, then renamed."""
    aside = path.with_name(f".{path.name}.{os.getpid()}.partial")
    with disk_errors(path):
        aside.write_bytes(data)
        aside.replace(path)


def write_dataset(dataset: xr.Dataset, path: Path) -> None:
    """Write a small Dataset as a Zarr store, whole or not at all."""
    words = {name: variable for name, variable in dataset.variables.items() if variable.dtype.kind == "U"}
    dataset = dataset.assign({name: (word.dims, texts(word.to_numpy()), word.attrs) for name, word in words.items()})
    aside = path.with_name(f".{path.name}.partial")
    with disk_errors(path):
        remove(aside)
        dataset.to_zarr(aside, mode="w", zarr_format=3, consolidated=False)
        remove(path)
        aside.replace(path)


def open_dataset(path: Path, only: Collection[str] = ()) -> xr.Dataset:
    """Return the Dataset of a store, or only some of its variables, in memory; text as objects.

    Raises
    ------
    MissingStoreError
        Where there is none.
    """
    try:
        dataset: xr.Dataset = xr.open_zarr(path, consolidated=False, chunks=None)
    except (FileNotFoundError, zarr.errors.NodeNotFoundError, zarr.errors.GroupNotFoundError) as error:
        raise MissingStoreError("there is no Dataset here", str(path), remedy="Run the stage that writes it") from error
    dataset = (dataset[list(only)] if only else dataset).load()
    return dataset.assign(
        {name: word.astype(object) for name, word in dataset.data_vars.items() if word.dtype.kind == "T"}
    )


def remove(path: Path) -> None:
    """Delete a store, a folder or a file, if it is there."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


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
    if path.exists() and not overwrite and not attributes(path) and not (path.is_dir() and not any(path.iterdir())):
        raise DestinationError(
            "this place holds something else",
            str(path),
            "nothing, or a store of tract_dask",
            "a folder" if path.is_dir() else "a file",
            "Choose another place, or say --overwrite",
        )
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
            error.strerror or str(error),
            "Choose another place, or mend its permissions",
        ) from error


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
    """Turn a full disk or a refused write inside this block into a StoreError that says so."""
    try:
        yield
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS):
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
