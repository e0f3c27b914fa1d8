"""The command line."""

from __future__ import annotations

import os
import signal
import sys
import threading
import traceback
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, NoReturn

import click

from ..errors import ExitCode, InputError, TractError, check_system
from . import interrupts
from .jobs import cancel, jobs, submit, watch
from .options import Command
from .results import compare_filters, export, figures, report, verify
from .run import columns, convert, demo, drift, fit, inspect, run
from .serve import certs, serve, token
from .show import DEBUG
from .simulate import simulate
from .streams import is_full, nobody_reads


class Group(click.Group):
    """Commands whose errors end as one readable paragraph and an exit code."""

    command_class = Command

    def list_commands(self, ctx: click.Context) -> list[str]:
        """Return the commands in the order of the work."""
        return list(self.commands)

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; turn what it raises into an exit code."""
        try:
            check_system()
            _check_folder()
            with _terminated_as_interrupted():
                return super().invoke(ctx)
        except KeyboardInterrupt:
            click.echo(interrupts.SENTENCE, err=True)
            ctx.exit(ExitCode.INTERRUPTED)
        except (click.ClickException, click.Abort, click.exceptions.Exit):
            raise
        except TractError as error:
            self._explain(ctx, f"Error: {error}", error.exit_code)
        except OSError as error:
            if isinstance(error, BrokenPipeError) and nobody_reads():
                raise  # click ends the command without a word, as other programs end
            text = f"Error: what this command prints cannot be written: {error.strerror}. Print it elsewhere."
            self._explain(ctx, text if is_full(error) else _unexpected(error), ExitCode.FAILED)
        except Exception as error:  # noqa: BLE001  the last resort of the command line, which has to explain itself
            self._explain(ctx, _unexpected(error), ExitCode.FAILED)

    def _explain(self, ctx: click.Context, text: str, code: int) -> None:
        if ctx.meta.get(DEBUG):
            traceback.print_exc()
        with suppress(OSError):
            click.echo(text, err=True)
        ctx.exit(code)


def _unexpected(error: Exception) -> str:
    said = str(error).rstrip(".")
    return f"Error: unexpected {type(error).__name__}: {said}. Add --debug to see where; what is done is kept."


def _check_folder() -> None:
    """Refuse to work in a folder that has been removed."""
    try:
        Path.cwd()
    except OSError as error:
        remedy = "Go to a folder that is there (cd), and try again"
        raise InputError("the working folder is gone", got=error.strerror or "", remedy=remedy) from error


@click.group(name="tract", cls=Group, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(package_name="tract_dask", prog_name="tract-dask")
def main() -> None:
    """Track atomic columns through a TEM movie of any length.

    The whole job is "tract-dask run movie.tif out"; "tract-dask demo" shows it on a simulated movie.
    """


_STAGES = (run, inspect, convert, drift, columns, fit)
_RESULTS = (verify, compare_filters, demo, report, export, figures)
_SERVICE = (serve, token, certs, submit, jobs, watch, cancel)
for _command in (*_STAGES, *_RESULTS, simulate, *_SERVICE):
    main.add_command(_command)


@contextmanager
def _terminated_as_interrupted() -> Iterator[None]:
    """Let SIGTERM end the command as Ctrl-C does: workers stopped, what is done kept."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(number: int, frame: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def command() -> NoReturn:
    """Run the command line as a process, and end it at once.

    To take apart all that was imported takes Python a second or more, and nothing depends on it: what was written is on
    disk, the workers are gone, and their server ends with this process.
    """
    interrupts.install()
    code: object = 0
    try:
        main()
    except SystemExit as ended:
        code = ended.code
    except KeyboardInterrupt:  # just before a command has begun, or after its end
        interrupts.end_at_once()
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError):  # whoever read it may be gone
            stream.flush()
    os._exit(code if isinstance(code, int) else int(code is not None))
