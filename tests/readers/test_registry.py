"""Readers of other packages: by an entry point; one that is broken is a warning and nothing worse."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np

READER = """
import numpy as np
from tract_dask.readers import Reader
from tract_dask.readers.npy import open_npy

READER = Reader("Camera", (".cam",), open_npy)
NO_READER = 5
"""
ENTRIES = "[tract_dask.readers]\ngood = camera:READER\nnot = camera:NO_READER\ngone = no_such_package:X\n"
SCRIPT = """
import sys, warnings
from pathlib import Path
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    from tract_dask.readers import open_source
print(*sorted(str(item.message).split(" (")[0] for item in caught), sep="|")
print(open_source(sys.argv[1]).shape)
"""


def test_a_package_adds_a_reader(tmp_path: Path) -> None:
    (tmp_path / "camera.py").write_text(READER)
    about = tmp_path / "camera-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: camera\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(ENTRIES)
    with (tmp_path / "movie.cam").open("wb") as file:
        np.save(file, np.zeros((3, 4, 5)))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(tmp_path), *sys.path))}
    call = [sys.executable, "-c", SCRIPT, str(tmp_path / "movie.cam")]
    said = subprocess.run(call, env=environment, capture_output=True, text=True, check=True).stdout
    assert said == "the entry point not|the reader gone\n(3, 4, 5)\n"
