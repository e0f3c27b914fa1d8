"""Mutated files of every format, by the thousand, each within limits.

``python -m benchmarks.cases.fuzz.readers 0 10000`` reads 10,000 of them. The bases and mutations are those of
tests/readers/test_reader_fuzz.py, which runs a few of each. Right: every file gives frames or an error of ours, within
10 s and 3 GiB, and at least 30 % of a format open; a process that dies costs its one file, and is told. Files
that open, but whose first or last frame is damaged and refused, are counted beside those that are read.
"""

from __future__ import annotations

import argparse
import json
import resource
import runpy
import signal
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ..common import Clock, work_folder

TESTS = Path(__file__).parents[3] / "tests" / "readers" / "test_reader_fuzz.py"
MEMORY_BYTES = 3 << 30
LIMIT_S = 10
"""Of processor time, so that a busy machine changes nothing; and six times of it in all, for files that only wait."""
SLOW_S = 3.0
BATCH = 1000


class _Late(BaseException):
    """The file took too long."""


def _late(*_: object) -> None:
    raise _Late


def read(first: int, last: int, folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the seed before, and the outcome after, each mutated file was read."""
    sys.path.insert(0, str(TESTS.parents[1] / "helpers"))  # where the tests' writers are
    fuzz = runpy.run_path(str(TESTS))
    bases = sorted(fuzz["BASES"])
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    for number in (signal.SIGALRM, signal.SIGPROF):
        signal.signal(number, _late)
    for seed in range(first, last):
        name = bases[seed % len(bases)]
        yield {"seed": seed, "name": name}
        path = folder / name
        path.unlink(missing_ok=True)
        fuzz["BASES"][name](path)
        path.write_bytes(fuzz["mutated"](path.read_bytes(), seed))
        for timer, seconds in ((signal.ITIMER_PROF, LIMIT_S), (signal.ITIMER_REAL, 6 * LIMIT_S)):
            signal.setitimer(timer, seconds)
        with Clock() as clock:
            end = _outcome(fuzz, path)
        for timer in (signal.ITIMER_PROF, signal.ITIMER_REAL):
            signal.setitimer(timer, 0)
        yield {"seed": seed, "name": name, "end": "slow" if end == "ok" and clock.cpu_s > SLOW_S else end}


def _outcome(fuzz: dict[str, Any], path: Path) -> str:
    try:
        return str(fuzz["outcome"](path))
    except _Late:
        return "HANG"
    except Exception as error:  # noqa: BLE001 - any is what is looked for
        return f"RAW {type(error).__name__}: {error}"[:120]


def batch(first: int, last: int) -> Iterator[dict[str, Any]]:
    """Yield the outcomes of files that another process reads; where it dies, that is the last file's outcome."""
    command = [sys.executable, "-m", __spec__.name if __spec__ else __name__, str(first), str(last), "--here"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    begun: dict[str, Any] | None = None
    for line in process.stdout or ():
        record = json.loads(line)
        begun = None if "end" in record else record
        if begun is None:
            yield record
    if process.wait() and begun:
        yield begun | {"end": f"DIED with {process.returncode}"}


def main() -> None:
    """Print what is neither frames nor an error of ours, and how often each end came."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("first", type=int, nargs="?", default=0)
    parser.add_argument("last", type=int, nargs="?", default=1000)
    parser.add_argument("--here", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.here:
        with work_folder() as folder:
            for record in read(options.first, options.last, folder):
                print(json.dumps(record), flush=True)
        return
    ends: Counter[str] = Counter()
    opened: dict[str, list[str]] = defaultdict(list)
    at = options.first
    while at < options.last:
        for record in batch(at, min(at + BATCH, options.last)):
            ends[record["end"].split(":")[0]] += 1
            opened[Path(record["name"]).suffix].append(record["end"])
            at = record["seed"] + 1
            if record["end"] not in ("ok", "opened", "refused"):
                print(record, flush=True)
    print(dict(ends))
    for suffix, ended in sorted(opened.items()):
        is_read, is_open = (np.mean([end in which for end in ended]) for which in (("ok",), ("ok", "opened")))
        print(f"{suffix:<7}{len(ended):>5} files, {is_open:.0%} open, {is_read:.0%} read")


if __name__ == "__main__":
    main()
