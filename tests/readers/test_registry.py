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

def broken(*arguments):
    raise RuntimeError("it broke")

READER = Reader("Camera", (".cam",), open_npy)
BROKEN = Reader("Broken", (".brk",), broken, is_movie=broken, parts=broken)
NO_SUFFIX = Reader("Bare", ("cam",), open_npy)
TAKES = Reader("Other NumPy", (".npy",), broken)
NO_READER = 5
"""
ENTRIES = """[tract_dask.readers]
broken = camera:BROKEN
bare = camera:NO_SUFFIX
takes = camera:TAKES
not = camera:NO_READER
gone = no_such_package:X
leaves = leaver:X
good = camera:READER
"""
SCRIPT = """
import sys, warnings
from pathlib import Path
from tract_dask.readers import open_source
folder = Path(sys.argv[1])
with warnings.catch_warnings(record=True) as caught:
    warnings.simplefilter("always")
    print(open_source(folder / "movie.npy").shape, "camera" in sys.modules)
    print(open_source(folder / "movie.cam").shape)
    print(open_source(folder / "frames").shape)
    try:
        open_source(folder / "movie.brk")
    except Exception as error:
        print(type(error).__name__, error)
print(*sorted({str(item.message).split(" (")[0] for item in caught}), sep="|")
"""


def test_a_package_adds_a_reader(tmp_path: Path) -> None:
    (tmp_path / "camera.py").write_text(READER)
    about = tmp_path / "camera-1.0.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: camera\nVersion: 1.0\n")
    (about / "entry_points.txt").write_text(ENTRIES)
    (tmp_path / "leaver.py").write_text("raise SystemExit(3)")
    (tmp_path / "frames").mkdir()
    for name in ("movie.cam", "movie.npy", "movie.brk", "frames/a_1.cam", "frames/a_2.cam"):
        with (tmp_path / name).open("wb") as file:
            np.save(file, np.zeros((3, 4, 5)))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join((str(tmp_path), *sys.path))}
    call = [sys.executable, "-c", SCRIPT, str(tmp_path)]
    said = subprocess.run(call, env=environment, capture_output=True, text=True, check=True).stdout
    lines = said.splitlines()
    assert lines[:3] == ["(3, 4, 5) False", "(3, 4, 5)", "(6, 4, 5)"]
    assert lines[3].startswith("SourceError")
    assert "the reader broken (camera:BROKEN) cannot read the file" in lines[3]
    named = "the reader bare|the reader broken|the reader gone|the reader leaves|the reader not"
    assert lines[4] == named
