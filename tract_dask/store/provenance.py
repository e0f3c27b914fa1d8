"""Where a store came from: fingerprints of inputs, keys of stages, versions and times."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import platform
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from functools import cache, lru_cache
from itertools import accumulate, groupby
from pathlib import Path
from typing import Any

import numpy as np
from llvmlite.binding import get_host_cpu_name  # type: ignore[import-untyped]
from numba.core import config

from ..kernels.vectors.tracing import LANES
from ..settings.declare import Settings
from ..settings.toml import to_toml

WHOLE_BYTES = 32 << 20
"""Files that hold no more than this together are read whole for their fingerprint."""

_END_BYTES = 1 << 20
_SAMPLES = 64
_SAMPLE_BYTES = 1 << 16
_FILE_BYTES = 1 << 14
_GOLDEN = 0.6180339887498949


def fingerprint(*paths: Path) -> str:
    """Return a fingerprint of what files hold, whatever their names, folders and times.

    Small movies are read whole. Of others, whose hash would cost as much as their conversion, these are read: the first
    and the last megabyte of the first and the last file, 64 blocks of 64 KiB spread over all, and a block from the
    middle of each file.
    """
    sizes = [path.stat().st_size for path in paths]
    digest = hashlib.sha256(json.dumps(sizes).encode())
    for number, blocks in groupby(_samples(sizes), key=lambda block: block[0]):
        with paths[number].open("rb") as file:
            for _, offset, count in blocks:
                file.seek(offset)
                digest.update(file.read(count))
    return digest.hexdigest()


def _samples(sizes: list[int]) -> Iterator[tuple[int, int, int]]:
    """Yield the blocks that stand for files of these sizes, in order: number of the file, offset, bytes."""
    if sum(sizes) <= WHOLE_BYTES:
        yield from ((number, 0, size) for number, size in enumerate(sizes))
        return
    starts = [0, *accumulate(sizes)]
    blocks = [(number, 0, _END_BYTES) for number in (0, len(sizes) - 1)]
    blocks += [(number, max(0, sizes[number] - _END_BYTES), _END_BYTES) for number in (0, len(sizes) - 1)]
    for k in range(_SAMPLES):  # one in each part of the whole, not at the same place of each: frames are alike there
        place = int((k + k * _GOLDEN % 1) / _SAMPLES * starts[-1])
        number = int(np.searchsorted(starts, place, side="right")) - 1
        blocks.append((number, max(0, min(place - starts[number], sizes[number] - _SAMPLE_BYTES)), _SAMPLE_BYTES))
    if len(sizes) > 1:
        blocks += [(number, max(0, size - _FILE_BYTES) // 2, _FILE_BYTES) for number, size in enumerate(sizes)]
    yield from sorted(set(blocks))


def provenance(key: str, settings: Settings, source: str = "") -> dict[str, Any]:
    """Return what every store carries about its making, ready to be stored as attributes."""
    return {
        "key": key,
        "settings": to_toml(settings),
        "source": source,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "processor": processor(),
        "versions": versions(),
    }


@cache
def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that make results."""
    packages = ("tract_dask", "numpy", "numba", "zarr", "dask")
    return {"python": platform.python_version()} | {name: importlib.metadata.version(name) for name in packages}


_LANES = " lanes"


@lru_cache(maxsize=1)
def processor() -> str:
    """Return the kind of this processor, as LLVM calls it, and how many numbers the fitter's vectors hold.

    Examples
    --------
    >>> processor().endswith(" lanes")
    True
    """
    return f"{config.CPU_NAME or get_host_cpu_name()}, {LANES}{_LANES}"


def widths(processors: Iterable[str]) -> list[int]:
    """Return the different numbers of lanes among kinds of processors, ascending.

    Examples
    --------
    >>> widths(["haswell, 8 lanes", "znver4, 16 lanes", "znver3, 8 lanes"])
    [8, 16]
    """
    return sorted({int(kind.removesuffix(_LANES).rsplit(maxsplit=1)[-1]) for kind in processors})
