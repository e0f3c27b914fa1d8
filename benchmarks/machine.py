"""What the benchmark ran on."""

from __future__ import annotations

import importlib.metadata
import platform
from pathlib import Path

import psutil

PACKAGES = ("tract_dask", "numpy", "numba", "scipy", "dask", "distributed", "zarr", "zarrs", "tifffile", "xarray")
_VECTOR_FEATURES = ("sse4_2", "avx2", "fma", "avx512f", "avx512bw", "avx512vl", "asimd", "sve")


def describe() -> dict[str, object]:
    """Return processor, memory, Python and package versions."""
    said = _cpuinfo()
    flags = said.get("flags", said.get("Features", "")).split()
    return {
        "cpu": said.get("model name", platform.processor() or platform.machine()),
        "cores": psutil.cpu_count(),
        "vector_features": [name for name in _VECTOR_FEATURES if name in flags],
        "memory_gb": round(psutil.virtual_memory().total / 1e9, 1),
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "packages": {name: importlib.metadata.version(name) for name in PACKAGES},
    }


def _cpuinfo() -> dict[str, str]:
    """Return the fields of the first processor; empty where the system does not tell."""
    file = Path("/proc/cpuinfo")
    lines = file.read_text(encoding="utf-8").split("\n\n")[0].splitlines() if file.exists() else []
    pairs = (line.partition(":") for line in lines)
    return {name.strip(): value.strip() for name, _, value in pairs}
