"""What commands share: options, progress, and how they show what they found."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from ..errors import ExitCode
from .options import Command

if TYPE_CHECKING:
    from ..progress import Sink


F = TypeVar("F", bound=Callable[..., Any])

PATH = click.Path(path_type=Path)

DEBUG = "tract_dask.debug"
"""Key of click's context under which ``--debug`` is kept."""


class Subgroup(click.Group):
    """Commands of one subject."""

    command_class = Command

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands in the order of the work."""
        return list(self.commands)


debug_option = click.option(
    "--debug",
    is_flag=True,
    expose_value=False,
    callback=lambda ctx, param, value: ctx.meta.update({DEBUG: value}),
    help="Show where in the program an error occurred.",
)


def common_options(function: F) -> F:
    """Give a command ``--json`` and ``--debug``."""
    as_json = click.option("--json", "as_json", is_flag=True, help="Print the result as JSON; progress goes to stderr.")
    return as_json(debug_option(function))


def show(found: dict[str, Any], *, as_json: bool) -> None:
    """Print a mapping as JSON, or as lines of names and values."""
    if as_json:
        click.echo(json.dumps(found))
        return
    width = max(map(len, found), default=0)
    for name, value in found.items():
        for k, line in enumerate(value if isinstance(value, list) else [value]):
            click.echo(f"{name if k == 0 else '':<{width}}  {'-' if line is None else line}")


overwrite_option = click.option("--overwrite", is_flag=True, help="Replace what is there.")


@contextmanager
def progress() -> Iterator[Sink]:
    """Yield a sink that shows progress on standard error."""
    from .terminal import Terminal

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    with Terminal() as terminal:
        yield terminal


def exit_for(bad_frames: int) -> None:
    """End with the exit code for frames that could not be fitted, if there are any."""
    if bad_frames:
        click.get_current_context().exit(ExitCode.BAD_FRAMES)
