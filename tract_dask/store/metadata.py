"""What a store says of itself: its format, key and checksums."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DestinationError, MissingStoreError, StoreError, TractError
from .damage import METADATA, damaged, read_json
from .files import write_aside
from .held import check_held
from .shard_files import CHECKSUM_BYTES, crc32c, trailing

ATTRIBUTE = "tract_dask"
"""Name of the attribute under which every store keeps its provenance and its own metadata."""

FORMAT = 2
"""Number of the format in which stores are written. In format 1 chunks had no checksums, and stores no number."""

CHUNKS = "chunks"
"""Attribute that names the files of the chunks without marks, each with its checksum: none can change places."""

_MARKS = ("frame_bad_pixels", "fit_ref", "quality", "exposure")
"""Arrays by which our stores are known where they do not say what they are."""


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
    marked = not metadata and _is_marked(path)
    if marked:
        metadata = read_json(file)  # it may have been put there between the two looks
    found = metadata.get("attributes", {}).get(ATTRIBUTE)
    if not isinstance(found, dict):
        if marked or (metadata and _is_marked(path)):
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
            "Install that version or a newer one, or remove the store and make it again",
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
    check_named(path, about, [name for name in about.get("arrays", ()) if name not in changing])
    for name in changing:
        if not read_json(path / name / METADATA):
            raise damaged(path / name / METADATA, "no such file", "is missing")


def format_of(about: Mapping[str, Any]) -> int:
    """Return the number of a store's format, by its attributes; 1 for stores that have none."""
    try:
        return math.ceil(float(about["format"]))
    except (KeyError, TypeError, ValueError, OverflowError):
        return 1  # where it was the format of a movie's source, in words


def update_attributes(
    path: Path, *, plain: Mapping[str, Any] | None = None, changed: Collection[str] = (), **changes: Any
) -> None:
    """Change what the store at ``path`` says of itself; written aside, then renamed.

    ``plain`` are attributes that stand beside :data:`ATTRIBUTE`, for other readers; ``changed`` are arrays that have
    been written anew.
    """
    attributes(path)  # refuses one that is damaged
    metadata = read_json(path / METADATA)
    known = metadata.setdefault("attributes", {})
    known.update(plain or {})
    known.setdefault(ATTRIBUTE, {}).update(changes)
    write_root(path, metadata, changed)


def write_root(path: Path, metadata: dict[str, Any], changed: Collection[str] = ()) -> None:
    """Write the root's metadata of a store, with the number of the format and checksums of all metadata.

    Parameters
    ----------
    changed
        Arrays whose metadata or chunks have changed since the root was last written; all where that was never.
    """
    ours = metadata.setdefault("attributes", {}).setdefault(ATTRIBUTE, {})
    known = ours.get("arrays")
    names = list(node_names(path)) if known is None else changed
    ours["arrays"] = (known or {}) | {name: digest(read_json(path / name / METADATA)) for name in names}
    ours[CHUNKS] = dict(sorted((_others(ours, names) | _checksums(path, names)).items()))
    ours["format"] = FORMAT
    ours.pop("checksum", None)
    metadata = json_ready(metadata)
    ours = metadata["attributes"][ATTRIBUTE]
    ours["checksum"] = digest(metadata)
    write_aside(path / METADATA, json.dumps(metadata).encode())


def _others(about: Mapping[str, Any], names: Collection[str]) -> dict[str, int]:
    """Return the checksums of chunks that a store names, but for those of some arrays."""
    known = about.get(CHUNKS, {})
    return {file: checksum for file, checksum in known.items() if file.rpartition("/")[0] not in names}


def _checksums(path: Path, names: Iterable[str]) -> dict[str, int]:
    """Return the checksum behind each chunk of some arrays, by its file; those in shards have marks instead."""
    found = {}
    for name in names:
        codecs = read_json(path / name / METADATA).get("codecs", ())
        if codecs and codecs[-1]["name"] == "crc32c":
            for file in (path / name).glob("c*"):
                with file.open("rb", buffering=0) as opened:
                    opened.seek(max(0, file.stat().st_size - CHECKSUM_BYTES))
                    found[f"{name}/{file.name}"] = trailing(opened.read())
    return found


def forget(path: Path, names: Collection[str]) -> None:
    """Take the chunks of some arrays out of what a store knows, before they are written anew: that may be cut off."""
    metadata = read_json(path / METADATA)
    ours = metadata.get("attributes", {}).get(ATTRIBUTE, {})
    ours[CHUNKS] = _others(ours, names)
    write_root(path, metadata)


def seal(path: Path) -> None:
    """Give a new store the number of the format, and checksums of the metadata and of the chunks of all its arrays."""
    metadata = read_json(path / METADATA)
    ours = metadata.setdefault("attributes", {}).setdefault(ATTRIBUTE, {})
    ours.pop("arrays", None)
    ours.pop(CHUNKS, None)
    write_root(path, metadata)


def nodes(store: Path) -> list[str]:
    """Return the names of the arrays and groups that a store holds, or should."""
    about = attributes(store)
    return list(about["arrays"] if "arrays" in about else node_names(store))


def read_node(store: Path, name: str) -> dict[str, Any]:
    """Return the metadata of an array or group of a store, checked.

    Raises
    ------
    StoreError
        Where they are damaged or missing.
    """
    return _read_node(store, attributes(store), name)


def node_names(path: Path, inside: str = "") -> Iterator[str]:
    """Yield the names of the arrays and groups inside a group, whatever their depth."""
    for folder in sorted((path / inside).iterdir()):
        if (about := read_json(folder / METADATA) if folder.is_dir() else {}) and not folder.name.startswith("."):
            name = f"{inside}{folder.name}"
            yield name
            if about.get("node_type") == "group":
                yield from node_names(path, f"{name}/")


def digest(metadata: dict[str, Any]) -> int:
    """Return the CRC-32C of metadata, whatever their white space and the order of their names."""
    return crc32c(json.dumps(metadata, sort_keys=True, separators=(",", ":")).encode())


def check_named(store: Path, about: Mapping[str, Any], names: Iterable[str]) -> None:
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


def abandon(path: Path) -> None:
    """Say in a store that it is to be made anew, before it is deleted file by file: that may be interrupted."""
    with suppress(OSError, TractError):  # on a full disk, and in what is damaged already, it is deleted all the same
        if attributes(path).get("key"):
            update_attributes(path, complete=False, key="")


def check_place(path: Path) -> None:
    """Check that nothing lies at ``path``, or a store of ours.

    Raises
    ------
    DestinationError
        Where it is something else.
    """
    if path.exists() and not attributes(path) and not (path.is_dir() and not any(path.iterdir())):
        raise DestinationError(
            "the output already holds other data",
            str(path),
            "nothing, or a store of tract_dask",
            "a folder" if path.is_dir() else "a file",
            "Choose another place, or use --overwrite",
        )


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
    check_held(path)
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
            "Choose another place, or correct its permissions",
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
