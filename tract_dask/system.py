"""Where tract_dask runs."""

from __future__ import annotations

import sys

from .errors import InputError


def check_system() -> None:
    """Check that this is not Windows, which lacks what workers and stores are built on (fork, pread, file locks).

    Raises
    ------
    InputError
        Where it is.
    """
    if sys.platform == "win32":
        raise InputError(
            "tract_dask does not run on Windows",
            expected="Linux",
            got="Windows",
            remedy="Install and run it in WSL, the Linux inside Windows (wsl --install)",
        )
