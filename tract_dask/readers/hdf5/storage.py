"""Whether the pixels of an HDF5 data set are in its file: libhdf5 reads what was never written as the fill value."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py

from ...errors import SourceError
from ..checks import checked_claim, open_binary, truncated, unaccounted

_CHUNK_BYTES, _CHUNK_RATIO = 32 << 20, 100
"""A chunk may claim so many bytes, and so many times the bytes of its file."""


def check_storage(dataset: Any, where: str, files: tuple[Path, ...], raw_bytes: int) -> tuple[str, ...]:
    """Check that the pixels are in the files; return a note where some were never written.

    Parameters
    ----------
    files
        All files that the pixels come from.
    raw_bytes
        Bytes of raw pixels that lie in files of their own.

    Raises
    ------
    SourceError
        Where they are not, or a frame or a chunk claims more than the files can hold.
    """
    size = sum(file.stat().st_size for file in files)
    itemsize = dataset.dtype.itemsize
    checked_claim(math.prod(sorted(dataset.shape)[-2:]) * itemsize, size, where)
    properties = dataset.id.get_create_plist()
    layout, n_bytes = properties.get_layout(), math.prod(dataset.shape) * itemsize
    if properties.get_external_count():
        if raw_bytes < n_bytes:
            raise truncated(where, "before the last frame of its raw pixels", n_bytes, raw_bytes)
    elif layout == h5py.h5d.CONTIGUOUS and (offset := dataset.id.get_offset()) is not None and offset + n_bytes > size:
        raise truncated(where, "before the last frame", offset + n_bytes, size)
    if layout == h5py.h5d.CHUNKED:
        _check_chunks(dataset, size, where)
        _check_sums(dataset, where)
    return unwritten(dataset, where)


def unwritten(dataset: Any, where: str) -> tuple[str, ...]:
    """Return a note where a part of a data set was never written, or, of a virtual one, comes from nowhere.

    Raises
    ------
    SourceError
        Where nothing was ever written.
    """
    properties = dataset.id.get_create_plist()
    layout = properties.get_layout()
    if layout == h5py.h5d.VIRTUAL:
        return _uncovered(dataset, properties, where)
    if layout == h5py.h5d.CONTIGUOUS and not properties.get_external_count() and dataset.id.get_offset() is None:
        raise _never_written(where)
    if layout != h5py.h5d.CHUNKED:
        return ()
    expected = math.prod(-(-n // chunk) for n, chunk in zip(dataset.shape, dataset.chunks, strict=True))
    written = dataset.id.get_num_chunks()
    if not written:
        raise _never_written(where)
    return () if written >= expected else (_PARTLY.format(where, expected - written, expected),)


_PARTLY = "{}: {:,} of {:,} chunks were never written; their pixels are read as the fill value"


def _uncovered(dataset: Any, properties: Any, where: str) -> tuple[str, ...]:
    """Return a note where the sources of a virtual data set give fewer pixels than it has."""
    joined = h5py.h5s.create_simple(dataset.shape)
    joined.select_none()
    for number in range(properties.get_virtual_count()):
        space = properties.get_virtual_vspace(number)
        if space.get_select_type() != h5py.h5s.SEL_HYPERSLABS:
            return ()
        if space.is_regular_hyperslab() and h5py.h5s.UNLIMITED in sum(space.get_regular_hyperslab()[2:], ()):
            return ()  # as many as the sources have
        for block in _blocks(space):
            joined.select_hyperslab(*block, op=h5py.h5s.SELECT_OR)  # sources may overlap
    covered = joined.get_select_npoints()
    if covered >= (n_pixels := math.prod(dataset.shape)):
        return ()
    if not covered:
        raise _never_written(where)
    return (
        f"{where}: {n_pixels - covered:,} of {n_pixels:,} pixels of the virtual data set come from no file; they are"
        " read as the fill value",
    )


def _blocks(space: Any) -> Iterator[tuple[tuple[int, ...], ...]]:
    """Yield start, count, stride and block of the regular parts of a selection."""
    if space.is_regular_hyperslab():
        start, stride, count, block = space.get_regular_hyperslab()
        yield start, count, stride, block
        return
    for first, last in space.get_select_hyper_blocklist():
        ones = (1,) * len(first)
        yield tuple(map(int, first)), ones, ones, tuple(int(b) - int(a) + 1 for a, b in zip(first, last, strict=True))


def _check_chunks(dataset: Any, size: int, where: str) -> None:
    n_bytes = math.prod(dataset.chunks) * dataset.dtype.itemsize
    if n_bytes > _CHUNK_BYTES + _CHUNK_RATIO * size:
        raise SourceError(
            "one chunk would be far larger than the file can hold",
            where,
            f"at most {_CHUNK_BYTES + _CHUNK_RATIO * size:,} bytes from files of {size:,}",
            f"{n_bytes:,} bytes, chunks {dataset.chunks}",
            "The file is damaged, or repack it with h5repack -l CHUNK=1x512x512",
        )


_CHECKSUM_BYTES = 4


def _check_sums(dataset: Any, where: str) -> None:
    """Refuse chunks that are shorter than their checksum: libhdf5 reads before their beginning, and crashes.

    Raises
    ------
    SourceError
        Naming the first of them.
    """
    if not dataset.fletcher32:
        return

    def short(chunk: Any) -> Any:
        return chunk if chunk.size <= _CHECKSUM_BYTES else None

    if found := dataset.id.chunk_iter(short):
        raise SourceError(
            "a chunk is too short for its checksum",
            where,
            f"more than {_CHECKSUM_BYTES} bytes",
            f"{found.size} bytes for the chunk at {found.chunk_offset}",
            "The file is damaged: make the copy or the export again",
        )


_SIGN = b"\x89HDF\r\n\x1a\n"
_END_AT = {0: 40, 1: 44, 2: 28, 3: 28}
"""Where the superblock of each version has the end of what belongs to HDF5."""


def outside(file: Any, path: Path) -> tuple[str, ...]:
    """Return notes on bytes of a file that lie before or behind what belongs to HDF5; none of unusual superblocks."""
    before, size = int(file.userblock_size), path.stat().st_size
    notes = (f"{path.name}: the {before:,} bytes before its HDF5 data (user block) are not read",) if before else ()
    with open_binary(path) as opened:
        opened.seek(before)
        block = opened.read(52)
    place = _END_AT.get(block[8]) if len(block) == 52 and block.startswith(_SIGN) else None
    sizes = block[13] if len(block) == 52 and block[8] < 2 else block[9:10][0] if len(block) == 52 else 0
    if place is None or sizes != 8:
        return notes
    return notes + unaccounted(path.name, size - int.from_bytes(block[place : place + 8], "little"), 0)


def _never_written(where: str) -> SourceError:
    return SourceError(
        "no pixel of the data set was ever written",
        where,
        "stored frames",
        "room for them only",
        "Wait until the movie is written, or name another data set",
    )
