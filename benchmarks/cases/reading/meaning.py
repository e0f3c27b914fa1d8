"""Does a reader understand what a file says of its pixels, axes and units?

``python -m benchmarks.cases.reading.meaning``. Each line: what was read, and what is right. A refusal that names the
reason is right as well where it says so.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path

import h5py
import mrcfile
import numpy as np
import tifffile

from tract_dask.errors import TractError
from tract_dask.readers import open_source

from ..common import work_folder

FRAMES = np.random.default_rng(1).integers(1, 250, (6, 20, 24)).astype("u2")


def imagej_angstrom(folder: Path) -> str:
    """ImageJ writes the angstrom sign as a Java escape."""
    about = {"axes": "TYX", "unit": "\\u00C5"}
    tifffile.imwrite(folder / "movie.tif", FRAMES, imagej=True, metadata=about, resolution=(5, 5))
    return "20 pm"


def imagej_milliseconds(folder: Path) -> str:
    """The time of a frame with its unit as a word."""
    about = {"axes": "TYX", "finterval": 25.0, "tunit": "milliseconds"}
    tifffile.imwrite(folder / "movie.tif", FRAMES, imagej=True, metadata=about)
    return "0.025 s"


def mrc_without_cells(folder: Path) -> str:
    """A header whose cell has no division (mx = 0) tells no pixel size."""
    (folder / "movie.mrc").write_bytes(_header(mode=6, cella=(12.0, 10.0, 6.0)) + FRAMES.tobytes())
    return "pixel size unknown, not 1200 pm"


def mrc_unsigned_bytes(folder: Path) -> str:
    """Mode 0 is signed, unless the header's maximum is above 127."""
    limits = {"dmin": FRAMES.min(), "dmax": FRAMES.max(), "dmean": FRAMES.mean(), "rms": FRAMES.std()}
    (folder / "movie.mrc").write_bytes(_header(mode=0, mx=24, my=20, mz=6, **limits) + FRAMES.astype("u1").tobytes())
    return f"mean {FRAMES.mean():.2f}"


def white_is_zero(folder: Path) -> str:
    """A TIFF may say that 0 is white."""
    tifffile.imwrite(folder / "movie.tif", 255 - FRAMES.astype("u1"), photometric="miniswhite", metadata=None)
    return f"mean {FRAMES.mean():.2f}, or a note"


def frames_behind_the_first_page(folder: Path) -> str:
    """A description of tifffile's says 6 frames, with its keys in another order; the file has them behind one page."""
    text = json.dumps({"axes": "TYX", "truncated": True, "shape": [6, 20, 24]})
    tifffile.imwrite(folder / "movie.tif", FRAMES[0], description=text, metadata=None)
    with (folder / "movie.tif").open("ab") as file:
        file.write(FRAMES[1:].tobytes())
    return "6 frames, or a note"


def mrc_that_counts_short(folder: Path) -> str:
    """A header of 4 frames before the bytes of 6."""
    with mrcfile.new(folder / "movie.mrc") as file:
        file.set_data(FRAMES.astype("i2"))
    data = bytearray((folder / "movie.mrc").read_bytes())
    data[8:12] = struct.pack("<i", 4)
    (folder / "movie.mrc").write_bytes(data)
    return "6 frames, or a note on the bytes beyond"


def nexus_axes(folder: Path) -> str:
    """NXdata that names its axes y, x, frame."""
    with h5py.File(folder / "movie.h5", "w") as file:
        group = file.create_group("entry/data")
        group.attrs.update(NX_class="NXdata", signal="data")
        group.attrs["axes"] = ["y", "x", "frame_number"]
        group["data"] = np.moveaxis(FRAMES, 0, -1)
    return "(6, 20, 24), or refused"


def spectrum_image(folder: Path) -> str:
    """A HyperSpy signal whose last axis is an energy."""
    with h5py.File(folder / "movie.hspy", "w") as file:
        group = file.create_group("Experiments/a")
        group["data"] = np.moveaxis(FRAMES, 0, -1)
        for k, (name, units, moves) in enumerate((("y", "nm", True), ("x", "nm", True), ("Energy loss", "eV", False))):
            group.create_group(f"axis-{k}").attrs.update(name=name, units=units, scale=0.1, navigate=moves)
    return "refused"


def decimal_times(folder: Path) -> str:
    """Files named by times with decimals."""
    _pages(folder, [f"t_{t}s.tif" for t in ("0.05", "0.1", "0.15", "0.2")])
    return "frames 0 1 2 3"


def gain_reference(folder: Path) -> str:
    """A gain reference lies among the frames."""
    _pages(folder, [*(f"frame_{k:03d}.tif" for k in range(6)), "gain_ref.tif"])
    return "a note on gain_ref.tif"


def two_series(folder: Path) -> str:
    """Two series of frames lie in one folder."""
    _pages(folder, [f"{series}_{k:03d}.tif" for series in "ab" for k in range(3)])
    return "a note on two series"


CASES: tuple[Callable[[Path], str], ...] = (
    imagej_angstrom,
    imagej_milliseconds,
    mrc_without_cells,
    mrc_unsigned_bytes,
    white_is_zero,
    frames_behind_the_first_page,
    mrc_that_counts_short,
    nexus_axes,
    spectrum_image,
    decimal_times,
    gain_reference,
    two_series,
)


def _header(**fields: object) -> bytes:
    header = np.zeros((), mrcfile.dtypes.HEADER_DTYPE)
    header["nx"], header["ny"], header["nz"] = 24, 20, 6
    header["map"], header["machst"] = b"MAP ", [68, 68, 0, 0]
    for name, value in fields.items():
        header[name] = value
    return header.tobytes()


def _pages(folder: Path, names: list[str]) -> None:
    for k, name in enumerate(names):
        tifffile.imwrite(folder / name, np.full((20, 24), k, "u2"), metadata=None)


def seen(folder: Path) -> str:
    """Return what a reader makes of the one file of a folder, or of the folder where there are several."""
    files = sorted(folder.iterdir())
    try:
        source = open_source(files[0] if len(files) == 1 else folder)
        frames = source.read(0, source.shape[0])
    except TractError as error:
        return f"refused: {str(error).splitlines()[0]}"
    about, order = source.metadata, frames[:, 0, 0].tolist() if len(files) > 1 else f"mean {frames.mean():.2f}"
    return f"{source.shape} {order}, {about.pixel_size_pm} pm, {about.frame_time_s} s, notes {list(about.notes)}"


def main() -> None:
    """Print a line for each case."""
    for case in CASES:
        with work_folder() as folder:
            right = case(folder)
            print(f"{case.__name__}: {seen(folder)}\n    right: {right}", flush=True)


if __name__ == "__main__":
    main()
