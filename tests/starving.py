"""Readers that crash, hang and starve, for the service's processes: imported there, they read made-up formats."""

import multiprocessing
import os
import signal
import time
from pathlib import Path

import numpy as np

from tract_dask.io import READERS


def crash(path: Path, *_: object):
    os.kill(os.getpid(), signal.SIGSEGV)


def hang(path: Path, *_: object):
    time.sleep(60)


def starve(path: Path, *_: object):
    return np.ones(8 << 30, np.uint8)


if multiprocessing.parent_process() is not None:  # not where the tests are collected
    READERS |= {".crash": crash, ".hang": hang, ".starve": starve}
