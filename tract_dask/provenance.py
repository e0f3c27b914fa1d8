"""Where a store came from: fingerprints of inputs, keys of stages, versions and times."""

from __future__ import annotations

import hashlib
import importlib.metadata
import platform
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from .processor import processor
from .settings import Settings, to_toml

_SAMPLE_BYTES = 1 << 20


def fingerprint(*paths: Path) -> str:
    """Return a fingerprint of files: their names, sizes, times, and megabytes from the first and the last.

    Hashing a terabyte would cost as much as converting it; this changes whenever a file is written anew.
    """
    digest = hashlib.sha256()
    for path in paths:
        status = path.stat()
        digest.update(f"{path.name}:{status.st_size}:{status.st_mtime_ns}\n".encode())
    for path in {paths[0], paths[-1]}:
        with path.open("rb") as file:
            digest.update(file.read(_SAMPLE_BYTES))
            file.seek(max(0, path.stat().st_size - _SAMPLE_BYTES))
            digest.update(file.read(_SAMPLE_BYTES))
    return digest.hexdigest()


def stage_key(*parts: Settings | str | bytes) -> str:
    """Return the key of a stage's result: a hash of its settings and of the keys of what it read.

    Two results with the same key are the same; a stage is done when its store carries the key that it should have.
    """
    digest = hashlib.sha256()
    for part in parts:
        data = (
            to_toml(part).encode() if isinstance(part, Settings) else part.encode() if isinstance(part, str) else part
        )
        digest.update(len(data).to_bytes(8, "big") + data)
    return digest.hexdigest()


def provenance(key: str, settings: Settings, source: str = "") -> dict[str, Any]:
    """Return what every store carries about its making, ready to be stored as attributes."""
    packages = ("tract_dask", "numpy", "numba", "zarr", "dask")
    return {
        "key": key,
        "settings": to_toml(settings),
        "source": source,
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "processor": processor(),
        "versions": {"python": platform.python_version()}
        | {name: importlib.metadata.version(name) for name in packages},
    }
