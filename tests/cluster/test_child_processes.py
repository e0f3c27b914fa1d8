"""Child processes: lines in and out, their end with all that they started, and another start."""

import signal
import sys
import threading
import time

import psutil
import pytest

from tract_dask.cluster.child_processes import Child, Supervised, how_ended

ECHO = """
import sys
print("begun", file=sys.stderr)
for line in sys.stdin:
    print(line.upper(), end="", flush=True)
"""

PARENT = """
import subprocess, sys
code = "import time; print('up', flush=True); time.sleep(600)"
child = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
child.stdout.readline()
print(child.pid, flush=True)
sys.stdin.read()
"""


def python(code: str) -> list[str]:
    return [sys.executable, "-c", code]


def test_lines_go_in_and_come_out_and_the_end_of_its_input_is_its_end():
    errors: list[str] = []
    child = Child(python(ECHO), errors.append, talks=True)
    child.tell("one")
    child.tell("two")
    child.close()
    assert [line for line in child.lines(0.05) if line] == ["ONE", "TWO"]
    assert child.end(None) == 0
    assert errors == ["begun"]
    child.tell("three")  # nobody hears it


def test_silence_ticks_and_a_kill_takes_what_it_started_with_it():
    child = Child(python(PARENT), len, talks=True)
    lines = child.lines(0.05)
    grandchild = psutil.Process(int(next(line for line in lines if line)))
    assert next(lines) == ""
    assert child.end() == -signal.SIGKILL
    assert list(lines) == []
    grandchild.wait(10)


def test_what_it_started_ends_with_it_and_does_not_hold_its_lines_open():
    code = "import subprocess, sys; print(subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)']).pid)"
    child = Child(python(code), len, talks=True)
    (number,) = filter(None, child.lines(0.05))
    orphan = psutil.Process(int(number))
    assert child.end() == 0
    orphan.wait(10)


@pytest.mark.parametrize(
    ("code", "problem"),
    [
        ("import sys; sys.exit('no room')", "no room"),
        ("import os; os.kill(os.getpid(), 11)", "SIGSEGV"),
        ("raise SystemExit(3)", "exit code 3"),
    ],
)
def test_what_is_supervised_is_started_again_and_says_why_it_ended(monkeypatch, code, problem):
    monkeypatch.setattr("tract_dask.cluster.child_processes._SHORTEST_S", 0.01)
    ends, thrice = [], threading.Event()

    def ended() -> None:
        ends.append(time.monotonic())
        if len(ends) == 6:  # before each start and after each end
            thrice.set()

    child = Supervised("it", python(code), on_ended=ended)
    assert thrice.wait(30)
    assert child.problem == problem
    child.stop(5.0)
    assert not child.is_alive()


def test_a_supervised_process_gets_its_order_and_is_killed_where_it_does_not_end(tmp_path):
    file = tmp_path / "order"
    code = f"import pathlib, sys, time; pathlib.Path({str(file)!r}).write_text(input()); time.sleep(600)"
    child = Supervised("it", python(code), "do this")
    while not file.exists() or not file.read_text():
        time.sleep(0.01)
    assert child.is_alive()
    child.stop(0.1)
    assert child.problem == how_ended(-signal.SIGKILL)
