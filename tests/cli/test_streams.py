"""Standard output and error that are closed, full or read by nobody: commands say so, and runs go on."""

from __future__ import annotations

import errno
import io
import os
import subprocess
import sys

import click
import pytest
from click.testing import CliRunner

from tract_dask.cli import main as cli
from tract_dask.cli import streams
from tract_dask.cli.terminal import Terminal
from tract_dask.progress import Warned

OPENS = """
import sys
from tract_dask.cli.streams import open_standard
open_standard()
print("lost"); print("lost", file=sys.stderr)
with open(sys.argv[1], "w") as file:
    assert file.fileno() > 2
    print("lost", file=sys.stderr, flush=True)
    file.write("kept")
"""


class Broken(io.StringIO):
    """A stream of a disk that is full, or of a terminal that is gone."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number

    def write(self, text: str = "") -> int:
        raise OSError(self.number, os.strerror(self.number))

    flush = write


@pytest.mark.parametrize("closed", [(0, 1, 2), (1, 2), (2,)])
def test_what_is_closed_takes_no_file_s_place(tmp_path, closed):
    def close() -> None:
        for number in closed:
            os.close(number)

    done = subprocess.run([sys.executable, "-c", OPENS, str(tmp_path / "a")], preexec_fn=close, timeout=60)
    assert done.returncode == 0
    assert (tmp_path / "a").read_text() == "kept"


@pytest.mark.parametrize("number", [errno.EPIPE, errno.ENOSPC, errno.EIO])
def test_progress_that_cannot_be_shown_ends_nothing(monkeypatch, number):
    monkeypatch.setattr(sys, "stderr", Broken(number))
    with Terminal() as shown:
        shown(Warned("all is well"))


def test_progress_is_shown_where_it_can_be(capsys):
    Terminal()(Warned("all is well"))
    assert capsys.readouterr().err == "warning: all is well\n"


def outcome(error: BaseException) -> tuple[int, str]:
    @click.group(cls=cli.Group)
    def group() -> None:
        pass

    @group.command()
    def fail() -> None:
        raise error

    found = CliRunner().invoke(group, ["fail"])
    return found.exit_code, found.output


def test_an_output_that_is_full_is_named():
    code, text = outcome(OSError(errno.ENOSPC, "No space left on device"))
    assert code == 1
    assert text == "Error: what this command prints cannot be written: No space left on device. Print it elsewhere.\n"
    assert "unexpected PermissionError" in outcome(OSError(errno.EPERM, "no"))[1]


@pytest.mark.parametrize(("gone", "text"), [(True, ""), (False, "Error: unexpected BrokenPipeError")])
def test_a_reader_that_has_gone_is_no_error(monkeypatch, gone, text):
    """But a pipe to something else that broke is one."""
    monkeypatch.setattr(cli, "nobody_reads", lambda: gone)
    code, said = outcome(BrokenPipeError(errno.EPIPE, "Broken pipe"))
    assert code == 1
    assert said.startswith(text) if text else said == ""


def test_pipes_without_a_reader_are_known():
    code = "import sys; from tract_dask.cli.streams import nobody_reads; sys.exit(nobody_reads())"
    near, far = os.pipe()
    for expected in (0, 1):
        with subprocess.Popen([sys.executable, "-c", code], stdout=far) as process:
            if not expected:
                assert process.wait(60) == 0
                os.close(near)
            else:
                assert process.wait(60) == 1
    os.close(far)
    assert streams.is_full(OSError(errno.ENOSPC, "full"))
    assert not streams.is_full(OSError(errno.ENOSPC, "full", "a.zarr"))


def test_a_working_folder_that_is_gone_is_named(monkeypatch):
    def gone() -> str:
        raise FileNotFoundError(errno.ENOENT, "No such file or directory")

    monkeypatch.setattr(os, "getcwd", gone)
    code, text = outcome(RuntimeError("not reached"))
    assert (code, text.startswith("Error: the working folder is gone")) == (2, True)
