"""Names of a package that are imported when they are first used (PEP 562), and importing in less time."""

from __future__ import annotations

import gc
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any


def lazy_names(package: str, homes: dict[str, str]) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return the ``__getattr__`` and ``__dir__`` of a package.

    Parameters
    ----------
    package
        Its ``__name__``.
    homes
        The module inside the package that holds each name.

    Examples
    --------
    >>> find, names = lazy_names("tract_dask", {"open_movie": "movie"})
    >>> find("open_movie").__module__
    'tract_dask.movie'
    """

    def find(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(f".{homes[name]}", package), name)

    def names() -> list[str]:
        return sorted([*vars(sys.modules[package]), *homes])

    return find, names


@contextmanager
def uncollected() -> Iterator[None]:
    """Import without garbage collection, for a process of our own.

    What is imported lives until the process ends. To look through it again and again takes a fifth of the time of
    importing it, and makes forked processes copy its memory: so it is never looked at again either.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
