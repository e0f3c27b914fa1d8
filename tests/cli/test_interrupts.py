"""Ctrl-C in a real terminal, at any moment: one sentence, no traceback, exit code 130, and no process left."""

from __future__ import annotations

import os
import pty
import re
import select
import signal
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil
import pytest
from conftest import Scene

from tract_dask.cli.interrupts import SENTENCE
from tract_dask.run import pipeline
from tract_dask.settings import ClusterSettings, ConvertSettings, RunSettings

pytestmark = pytest.mark.timeout(300)  # imports and compilers take long on a busy machine

MARKED = """
import sys, time

class Marked:
    def find_spec(self, name, *about):
        if name == {name!r}:
            print("MARK", flush=True)
            time.sleep({pause})

sys.meta_path.insert(0, Marked())
from tract_dask.cli.__main__ import command
command()
"""
"""The program, which says when it imports a module, and waits there."""


@dataclass
class Played:
    """A program in a terminal of its own, with what it has written there."""

    arguments: list[str]
    text: str = ""
    began: float = field(default_factory=time.monotonic)

    def __enter__(self) -> Played:
        self.pid, self.terminal = pty.fork()
        if self.pid == 0:
            os.environ.update(TERM="xterm", COLUMNS="120")
            os.execv(sys.executable, [sys.executable, *self.arguments])
        return self

    def __exit__(self, *error: object) -> None:
        for process in self.processes():
            process.kill()

    def processes(self) -> list[psutil.Process]:
        try:
            return psutil.Process(self.pid).children(recursive=True)
        except psutil.NoSuchProcess:
            return []

    def read(self) -> bool:
        """Take what it writes; tell whether it has ended."""
        if not select.select([self.terminal], [], [], 0.1)[0]:
            return False
        try:
            written = os.read(self.terminal, 65536).decode(errors="replace")
            self.text += re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written)
        except OSError:
            return True
        return False

    def wait_for(self, mark: str) -> None:
        while not re.search(mark, self.text):
            assert not self.read(), self.text
            assert time.monotonic() - self.began < 120, self.text

    def ctrl_c(self) -> None:
        os.write(self.terminal, b"\x03")

    def end(self) -> tuple[int, float]:
        """Return exit code, and the time (s) to the end from now."""
        began = time.monotonic()
        while not self.read():
            assert time.monotonic() - began < 60, self.text
        _, status = os.waitpid(self.pid, 0)
        return os.waitstatus_to_exitcode(status), time.monotonic() - began


def check(played: Played, code: int) -> None:
    assert code == 130, played.text
    assert "Traceback" not in played.text, played.text
    assert played.text.count(SENTENCE) == 1, played.text


@pytest.fixture(scope="module")
def movie(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("interrupts") / "movie.npy"
    np.save(path, np.concatenate([Scene(n_frames=20).counts()] * 20))
    return path


def run_of(movie: Path, out: Path) -> list[str]:
    return ["run", str(movie), str(out), "--workers", "2", "--shard-mb", "1", "--no-report"]


@pytest.mark.parametrize(
    ("name", "pause"), [("click", 30), ("numpy", 30), ("distributed", 30), ("tract_dask.cluster.certificates", 0)]
)
def test_while_it_imports_and_while_workers_start(movie, tmp_path, name, pause):
    with Played(["-c", MARKED.format(name=name, pause=pause), *run_of(movie, tmp_path / "out")]) as played:
        played.wait_for("MARK")
        started = played.processes()
        played.ctrl_c()
        check(played, played.end()[0])
        assert not psutil.wait_procs(started, timeout=20)[1]


def test_while_workers_convert(movie, tmp_path):
    with Played(["-m", "tract_dask.cli.__main__", *run_of(movie, tmp_path / "out")]) as played:
        played.wait_for(r"convert .* [1-9]\d*/400 frames")
        started = played.processes()
        played.ctrl_c()
        check(played, played.end()[0])
        assert not psutil.wait_procs(started, timeout=20)[1]


@pytest.mark.slow
def test_while_workers_fit_and_twice_where_they_hang(movie, tmp_path):
    settings = RunSettings(convert=ConvertSettings(shard_mb=1), cluster=ClusterSettings(workers=2))
    pipeline.run(movie, tmp_path / "out", settings, until="columns")
    with Played(["-m", "tract_dask.cli.__main__", *run_of(movie, tmp_path / "out")]) as played:
        played.wait_for(r"fit .* [1-9]\d*/400 frames")
        played.ctrl_c()
        check(played, played.end()[0])
    with Played(["-m", "tract_dask.cli.__main__", *run_of(movie, tmp_path / "out")]) as played:
        played.wait_for(r"fit .* [1-9]\d*/400 frames")
        started = played.processes()
        for process in started:
            if process.name() != "tract-dask" and not process.children():
                process.send_signal(signal.SIGSTOP)
        played.ctrl_c()
        time.sleep(0.5)
        played.ctrl_c()
        code, seconds = played.end()
        check(played, code)
        assert seconds < 10.0, "the first one alone waits for them"
        assert not psutil.wait_procs(started, timeout=20)[1]
