"""Zarr and the file system: opening arrays with the fast codec pipeline, writing aside, checking destinations."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
import zarr

from .errors import DestinationError, MissingStoreError, StoreError
from .schema import texts

ATTRIBUTE = "tract_dask"
"""Name of the attribute under which every store keeps its provenance and its own metadata."""


@contextmanager
def codec_pipeline() -> Iterator[None]:
    """Open arrays inside this block with the ``zarrs`` codec pipeline, where it is installed."""
    if find_spec("zarrs") is None:
        yield
        return
    with zarr.config.set({"codec_pipeline.path": "zarrs.ZarrsCodecPipeline"}):
        yield


def open_array(path: Path, mode: str = "r") -> zarr.Array[Any]:
    """Return the Zarr array at ``path``.

    Raises
    ------
    StoreError
        Where there is no array.
    """
    try:
        with codec_pipeline():
            return zarr.open_array(str(path), mode=mode, zarr_format=3)
    except (FileNotFoundError, zarr.errors.NodeNotFoundError) as error:
        raise StoreError("there is no Zarr array here", str(path), remedy="Run the stage that writes it") from error


def attributes(path: Path) -> dict[str, Any]:
    """Return what the store at ``path`` says of itself under :data:`ATTRIBUTE`; empty where there is no such store."""
    try:
        metadata = json.loads((path / "zarr.json").read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return {}
    found = metadata.get("attributes", {}).get(ATTRIBUTE, {})
    return found if isinstance(found, dict) else {}


def update_attributes(path: Path, **changes: Any) -> None:
    """Change what the store at ``path`` says of itself; written aside, then renamed."""
    file = path / "zarr.json"
    metadata = json.loads(file.read_text(encoding="utf-8"))
    metadata.setdefault("attributes", {}).setdefault(ATTRIBUTE, {}).update(changes)
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
        Where it holds something else, or cannot be written.
    """
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
    """Turn a full disk or a refused write inside this block into a StoreError that says so.

    The zarrs pipeline puts the number of an operating system's error into the text of a RuntimeError.
    """
    try:
        yield
    except (OSError, RuntimeError) as error:
        told = re.search(r"\(os error (\d+)\)", str(error))
        code = error.errno if isinstance(error, OSError) else int(told[1]) if told else None
        if code not in (errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EPERM, errno.EROFS):
            raise
        raise StoreError(
            "writing failed",
            str(path),
            got=os.strerror(code),
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
