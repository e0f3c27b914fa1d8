"""A service of its own with tokens, over a data root of its own, on the loopback."""

from __future__ import annotations

import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import numpy as np

from ..common import Clock, work_folder

COMMAND = [sys.executable, "-m", "tract_dask.cli"]
WAIT_S = 120.0
JSON = {"Content-Type": "application/json"}
_SMALL = "/static/logo.svg"


@dataclass(frozen=True)
class Started:
    """A service that runs: its address, its data root, and the tokens of an administrator and of a user."""

    address: str
    root: Path
    tokens: dict[str, str]

    def client(self, who: str = "") -> httpx.Client:
        """Return a client with the token of ``who``, or without one."""
        headers = {"Authorization": f"Bearer {self.tokens[who]}"} if who else {}
        return httpx.Client(base_url=self.address, headers=headers, timeout=WAIT_S)


@contextmanager
def started() -> Iterator[Started]:
    """Start a service over a folder with one small movie, and stop it in the end."""
    with work_folder() as folder:
        root = folder / "root"
        root.mkdir()
        np.save(root / "movie.npy", np.random.default_rng(0).integers(0, 200, (6, 48, 40)).astype("u1"))
        tokens = {name: _token(folder, root, name, role) for name, role in (("boss", "admin"), ("alice", "user"))}
        serve = [*COMMAND, "serve", "--data-root", str(root), "--port", "0", "--tokens", "--workers", "1"]
        log = (folder / "log").open("w")
        process = subprocess.Popen(serve, stdout=subprocess.PIPE, stderr=log, text=True)
        try:
            yield Started(_address(process), root, tokens)
        finally:
            process.terminate()
            process.wait(60)


def tried(service: Started, name: str, request: Callable[[], httpx.Response]) -> httpx.Response:
    """Make a request, print how it ended and how long a small one of somebody else waited, and return its answer."""
    with Pings(service.address) as pings, Clock() as clock:
        answer = request()
    took = f"{answer.status_code}, {len(answer.content) / 1e6:.1f} MB in {clock.wall_s:.2f} s"
    print(f"{name}: {took}; others waited {pings.longest_s:.3f} s", flush=True)
    return answer


def _token(folder: Path, root: Path, name: str, role: str) -> str:
    file = folder / f"{name}.token"
    create = [*COMMAND, "token", "create", name, "--role", role, "--data-root", str(root), "--file", str(file)]
    subprocess.run(create, check=True, capture_output=True)
    return file.read_text().strip()


def _address(process: subprocess.Popen[str]) -> str:
    for line in process.stdout or ():
        if found := re.search(r"http://127\.0\.0\.1:\d+", line):
            return found[0]
    raise RuntimeError("the service did not start")


class Pings:
    """Ask the service for something small again and again, and note how long the longest answer took, s."""

    def __init__(self, address: str) -> None:
        self.longest_s = 0.0
        self._address, self._ready, self._over = address, threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._ping)

    def __enter__(self) -> Pings:
        self._thread.start()
        self._ready.wait(WAIT_S)
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _ping(self) -> None:
        with httpx.Client(base_url=self._address, timeout=WAIT_S) as client:
            client.get(_SMALL)  # a connection is made: that takes this process some time, not the service
            self._ready.set()
            while True:  # at least once, however short the request is
                began = time.perf_counter()
                client.get(_SMALL)
                self.longest_s = max(self.longest_s, time.perf_counter() - began)
                if self._over.wait(0.02):
                    return
