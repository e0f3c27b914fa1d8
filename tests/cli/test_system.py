"""Windows is refused in one sentence, before anything is started."""

from __future__ import annotations

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ON_WINDOWS = """
import asyncio, ctypes, multiprocessing, pathlib, random, selectors, socket, subprocess, tempfile, webbrowser
import sys, warnings
import click.testing, click.shell_completion
sys.platform = "win32"
warnings.simplefilter("always")
"""
"""What is imported already does not look for Windows' own modules."""


def on_windows(code: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", f"{ON_WINDOWS}\n{code}"]
    return subprocess.run(command, capture_output=True, text=True, timeout=120)


@pytest.mark.parametrize(
    "code",
    [
        "import tract_dask as td; td.run('a', 'b')",
        "import tract_dask as td; td.open_movie('a')",
        "from tract_dask import open_source",
    ],
)
def test_what_the_package_offers_is_refused(code):
    done = on_windows(code)
    assert done.returncode == 1
    assert done.stderr.rstrip().splitlines()[-1] == (
        "tract_dask.errors.InputError: tract_dask does not run on Windows. Expected Linux; got Windows. "
        "Install and run it in WSL, the Linux inside Windows (wsl --install)."
    )


def test_the_import_says_it_in_one_sentence():
    done = on_windows("import tract_dask")
    assert done.returncode == 0
    assert "tract_dask does not run on Windows: install and run it in WSL" in done.stderr


@pytest.mark.parametrize("command", [["run", "a.tif", "b"], ["inspect", "a.tif"], ["serve", "data"], ["jobs"]])
def test_the_command_is_refused(command):
    done = on_windows(
        f"from tract_dask.cli.main import main\nfrom click.testing import CliRunner\n"
        f"done = CliRunner().invoke(main, {command!r}); print(done.exit_code, done.output)"
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("2 ")
    assert "does not run on Windows" in done.stdout
    assert "WSL" in done.stdout


def test_the_classifiers_name_what_is_tested():
    project = tomllib.loads(Path(__file__).parents[2].joinpath("pyproject.toml").read_text())["project"]
    systems = [line for line in project["classifiers"] if line.startswith("Operating System")]
    assert systems == ["Operating System :: POSIX :: Linux"]
