"""Tracking of atomic columns in time-resolved TEM movies, out of core and distributed.

The public names are imported when they are first used, so that ``import tract_dask`` costs nothing; the file
``__init__.pyi`` says where each of them lies.
"""

from __future__ import annotations

import sys
from types import ModuleType
from typing import Any

import lazy_loader

from .errors import check_system

__version__ = "0.1.0"

_find, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name in __all__:
        check_system()
    return _find(name)


class _Package(ModuleType):
    """The package: its ``run`` is the function, also once the room of this name was imported."""

    def __setattr__(self, name: str, value: object) -> None:
        if name != "run" or not isinstance(value, ModuleType):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package

if sys.platform == "win32":
    import warnings

    warnings.warn(
        "tract_dask does not run on Windows: install and run it in WSL, the Linux inside Windows", stacklevel=2
    )
