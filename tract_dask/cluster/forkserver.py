"""The process from which local workers are forked, with everything imported that they need.

Started before the rest of the package is imported, it imports at the same time on another core. Workers then start at
once, share its memory until they write to it, and end without delay; spawned ones each import everything anew.
"""

from __future__ import annotations

import gc
import multiprocessing
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import forkserver, resource_tracker

AVAILABLE = sys.platform == "linux" and sys.version_info >= (3, 11, 1)
"""Elsewhere workers are spawned: Windows cannot fork, and on macOS system libraries do not survive it.

The server of Python 3.11.0 listens where every user of the machine can send it code (CVE-2022-42919).
"""

THREAD_VARIABLES = (
    "NUMBA_NUM_THREADS",
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "RAYON_NUM_THREADS",
    "BLOSC_NTHREADS",
    "ZARR_THREADING__MAX_WORKERS",
)

ENVIRONMENT = {
    **dict.fromkeys(THREAD_VARIABLES, "1"),
    "MALLOC_MMAP_THRESHOLD_": str(32 << 20),
    "MALLOC_TRIM_THRESHOLD_": str(64 << 20),
    "JE_ARROW_MALLOC_CONF": "background_thread:false",
}
"""What has to be set before a worker's libraries are loaded: one thread each; and freed memory is used again.

Arrow, which pandas imports where it is installed, would start a thread for its memory, and a process with threads
should not be forked.

Dask's own limit for that, 64 KiB, makes the system clear the pages of every buffer anew: as much work as decoding.
"""

_QUIET = "ignore:resource_tracker:UserWarning"

_PRELOAD = ["tract_dask.run.worker_imports"]


def start() -> None:
    """Start the server, if it can be used here and does not run yet; it ends with this process.

    Neither it nor what is forked from it hears Ctrl-C, which the terminal sends to all: this process ends them in
    good order.
    """
    if AVAILABLE:
        multiprocessing.set_forkserver_preload(_PRELOAD)
        start_tracker()  # which the server would start, and which hears nothing by itself
        with _environment(), _deaf():
            forkserver.ensure_running()


def start_tracker() -> None:
    """Start the process that removes what killed workers leave in shared memory, and let it do so without a word."""
    sys.warnoptions.append(_QUIET)  # handed on to the process
    try:
        resource_tracker.ensure_running()
    finally:
        sys.warnoptions.remove(_QUIET)


@contextmanager
def _deaf() -> Iterator[None]:
    """Let what is started in this block never see SIGINT; one that comes meanwhile reaches this process afterwards."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _environment() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in ENVIRONMENT}
    os.environ.update(ENVIRONMENT)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


@contextmanager
def uncollected() -> Iterator[None]:
    """Import without garbage collection, for a process of our own.

    What is imported lives until the process ends. To look through it again and again takes a fifth of the time of
    importing it, and makes forked processes copy its memory: so it is never looked at again either.
    """
    gc.disable()
    try:
        yield
    finally:
        gc.freeze()
        gc.enable()
