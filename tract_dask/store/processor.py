"""The kind of processor that numbers were computed on: their last digits depend on it."""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache

from llvmlite.binding import get_host_cpu_name  # type: ignore[import-untyped]
from numba.core import config

from ..kernels.vectors.tracing import LANES

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
