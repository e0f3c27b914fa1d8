"""The program ``tract-dask``: it answers Ctrl-C before it imports anything that takes time."""

from __future__ import annotations

from typing import NoReturn

from .interrupts import install
from .streams import open_standard


def command() -> NoReturn:
    """Run the command line as a process."""
    open_standard()
    install(working=False)
    from .main import command as run

    run()


if __name__ == "__main__":
    command()
