"""Readers that crash, hang and starve, for the service's processes: imported there, they read made-up formats."""

import multiprocessing
import os
import signal
import time
from pathlib import Path

import numpy as np

from tract_dask.readers import READERS, Reader
from tract_dask.service.process_pool import own_memory
from tract_dask.store.columns import column_dataset


def crash(path: Path, *_: object):
    os.kill(os.getpid(), signal.SIGSEGV)


def hang(path: Path, *_: object):
    time.sleep(60)


def starve(path: Path, *_: object):
    return np.ones(8 << 30, np.uint8)


def reserved() -> int:
    """Return the bytes of private memory that a table of one column takes, with the libraries that it needs."""
    before = own_memory("VmData")
    column_dataset([[1.0, 2.0]])
    return own_memory("VmData") - before


if multiprocessing.parent_process() is not None:  # not where the tests are collected
    READERS |= {f".{kind.__name__}": Reader(kind.__name__, (), kind) for kind in (crash, hang, starve)}
