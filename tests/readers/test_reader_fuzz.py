"""Mutated files of every format: each opens and reads, or ends with an error of ours; never with another one."""

from __future__ import annotations

import random
import re
import warnings
from collections.abc import Callable
from pathlib import Path

import files_classic
import h5py
import hdf5plugin
import mrcfile
import numpy as np
import pytest
import tifffile
from files_classic import eer, fei_records, mrc_4bit, stk
from files_dm import write_director, write_dm
from files_hdf5 import small_zarr, velox
from files_stamped import write_mib, write_seq, write_ser, write_tvips
from files_video import write_video

from tract_dask.errors import TractError
from tract_dask.readers import open_source
from tract_dask.settings import SourceSettings

FRAMES = np.random.default_rng(1).poisson(5, (5, 40, 36)).astype("u2")
DECLARED = SourceSettings(raw_shape=(0, 40, 36), raw_dtype="uint16")
LENGTHS = [(0.05, "nm"), (0.05, "nm"), (0.25, "s")]
CASES = 20
"""Mutations of each base in the suite; the same functions ran over 10,000 (see docs/reliability.md)."""


def tiff(path: Path, dtype: str = "u2", **options: object) -> None:
    tifffile.imwrite(path, FRAMES.astype(dtype), **{"photometric": "minisblack", **options})


def ome(path: Path) -> None:
    blocks = "".join(f'<TiffData IFD="{k}" FirstT="{4 - k}" PlaneCount="1"/>' for k in range(5))
    planes = "".join(f'<Plane TheT="{k}" DeltaT="{k / 10}"/>' for k in range(5))
    text = (
        '<?xml version="1.0"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06"><Image ID="Image:0">'
        '<Pixels DimensionOrder="XYZCT" Type="uint16" SizeX="36" SizeY="40" SizeC="1" SizeZ="1" SizeT="5"'
        f' PhysicalSizeX="0.2" TimeIncrement="0.5">{blocks}{planes}</Pixels></Image></OME>'
    )
    tiff(path, description=text.encode(), metadata=None)


def mrc(path: Path, dtype: str, extended: int = 0) -> None:
    with mrcfile.new(path, data=FRAMES.astype(dtype)) as file:
        file.voxel_size = 0.1
        if extended:
            file.set_extended_header(np.zeros(extended, "u1"))


def npy(path: Path, version: tuple[int, int], frames: np.ndarray = FRAMES) -> None:
    with path.open("wb") as file, warnings.catch_warnings(action="ignore"):
        np.lib.format.write_array(file, frames, version=version)


def odd_attributes(path: Path) -> None:
    with h5py.File(path, "w") as file:
        dataset = file.create_dataset("entry/data", data=FRAMES, chunks=(1, 40, 36), compression="gzip")
        dataset.attrs["pixel_size_nm"] = 0.004
        dataset.attrs["frame_time_ms"] = "40"
        dataset.attrs["pixel_size_pm"] = h5py.Empty("f4")
        dataset.attrs["frame_time_s"] = np.array([b"x", b"y"])
        file.attrs["pixel_size_m"] = dataset.ref
        file.attrs.create("frame_time_h", np.zeros(3, "u1, f4"))


def groups(path: Path) -> None:
    with h5py.File(path, "w") as file:
        at = file
        for k in range(60):
            at = at.create_group(f"g{k}")
            at["back"] = h5py.SoftLink("/g0")
        at["movie"], at["self"] = FRAMES, file["g0"]
        for k in range(100):
            file[f"many/{k}"] = np.zeros(3)


def links(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["a"], file["b"] = FRAMES[:3], FRAMES[3:]
        layout = h5py.VirtualLayout(FRAMES.shape, "u2")
        layout[:3], layout[3:] = (h5py.VirtualSource(file[name]) for name in "ab")
        file.create_virtual_dataset("entry/data", layout)
        file["gone"] = h5py.ExternalLink("gone.h5", "/x")
        del file["gone"]
        file["circle"] = h5py.ExternalLink(path.name, "/circle")


def emd(path: Path) -> None:
    with h5py.File(path, "w", libver="latest") as file:
        group = file.create_group("data/movie")
        group.attrs["emd_group_type"] = 1
        group["data"] = FRAMES
        for k, n in enumerate(FRAMES.shape):
            group[f"dim{k + 1}"] = np.arange(n)


def turned(path: Path) -> None:
    with h5py.File(path, "w") as file:
        group = file.create_group("entry/data")
        group.attrs.update({"NX_class": "NXdata", "signal": "counts"})
        group.attrs["axes"] = ["y", "x", "time"]
        group.create_dataset("counts", data=FRAMES.transpose(1, 2, 0), chunks=(40, 36, 1))
        group["time"] = np.arange(5.0)
        group["time"].attrs["units"] = "s"


def master(path: Path) -> None:
    with h5py.File(path, "w") as file:
        detector = file.create_group("entry/instrument/detector")
        detector["frame_time"], detector["pixel_mask"] = 0.5, np.eye(40, 36, dtype="u4")
        for k in (1, 2):
            part = FRAMES[3 * k - 3 : 3 * k]
            file.create_dataset(f"entry/data/data_{k:06d}", data=part, chunks=(1, 40, 36), **hdf5plugin.Bitshuffle())


def hyperspy(path: Path) -> None:
    with h5py.File(path, "w") as file:
        group = file.create_group("Experiments/x")
        group.create_dataset("data", data=FRAMES, chunks=(2, 20, 36), shuffle=True, fletcher32=True, compression="lzf")
        for k, unit in enumerate(("s", b"nm", "nm")):
            group.create_group(f"axis-{k}").attrs.update({"scale": 0.1, "units": unit})


SIGNED = (
    "ImageJ=1.54f\nimages=5\nframes=5\ncf=0\nc0=-32768.0\nc1=1.0\nvunit=gray\nunit=\\u00C5\nfinterval=25\ntunit=ms\n"
)
FEI = "[Scan]\r\nPixelWidth=3.3e-011\r\nPixelHeight=3.3e-011\r\n[Image]\r\nResolutionY=30\r\n"

BASES: dict[str, Callable[[Path], object]] = {
    "tiled.tif": lambda path: tiff(path, bigtiff=True, tile=(16, 16), compression="zstd"),
    "lzw.tif": lambda path: tiff(path, compression="lzw", predictor=True, rowsperstrip=7, byteorder=">"),
    "jpeg.tif": lambda path: tiff(path, "u1", compression="jpeg", tile=(16, 16)),
    "jxl.tif": lambda path: tiff(path, compression="jpegxl"),
    "j2k.tif": lambda path: tiff(path, compression="jpeg2000"),
    "png.tif": lambda path: tiff(path, compression="png"),
    "lzma.tif": lambda path: tiff(path, "f4", compression="lzma"),
    "half.tif": lambda path: tiff(path, "f2", rowsperstrip=7),
    "bits.tif": lambda path: tiff(path, "?"),
    "ome.tif": ome,
    "imagej.tif": lambda path: tifffile.imwrite(
        path, FRAMES, imagej=True, metadata={"axes": "TYX", "Info": "x" * 500, "Labels": list("abcde"), "finterval": 1}
    ),
    "bytes.mrc": lambda path: mrc(path, "i1", 160),
    "half.mrc": lambda path: mrc(path, "f2"),
    "words.mrc": lambda path: mrc(path, "u2", 3072),
    "nibbles.mrc": lambda path: mrc_4bit(path, FRAMES),
    "fei.mrc": lambda path: files_classic.mrc(
        path,
        FRAMES,
        6,
        extended=fei_records(5, Timestamp=range(1, 6), Alpha_tilt=range(5), Pixel_size_X=1e-11, Pixel_size_Y=1e-11),
        exttyp=b"FEI2",
    ),
    "movie.eer": lambda path: eer(path, FRAMES > 8, final=True),
    "movie.stk": lambda path: stk(path, FRAMES, [1, 2, 3, 4, 6], (1, 20), "nm"),
    "white.tif": lambda path: tiff(path, photometric="miniswhite"),
    "signed.tif": lambda path: tiff(path, description=SIGNED, metadata=None),
    "sem.tif": lambda path: tiff(path, metadata=None, extratags=[(34682, "s", 0, FEI, True)]),
    "one.npy": lambda path: npy(path, (1, 0), FRAMES.astype(">f8")),
    "two.npy": lambda path: npy(path, (2, 0), np.asfortranarray(FRAMES)),
    "three.npy": lambda path: npy(path, (3, 0), FRAMES > 5),
    "attributes.h5": odd_attributes,
    "groups.h5": groups,
    "links.h5": links,
    "emd.h5": emd,
    "movie.hspy": hyperspy,
    "raw.avi": lambda path: write_video(path, FRAMES.astype("u1"), "rawvideo"),
    "h264.mp4": lambda path: write_video(path, FRAMES.astype("u1"), "libx264", "yuv420p"),
    "png.mov": lambda path: write_video(path, FRAMES.astype("u1"), "png"),
    "stack.dm3": lambda path: write_dm(path, FRAMES, LENGTHS, order=">"),
    "stack.dm4": lambda path: write_dm(path, FRAMES, LENGTHS, {"DataBar": {"Exposure Time (s)": 0.1}}),
    "across.dm4": lambda path: write_dm(path, np.moveaxis(FRAMES, 0, 2), LENGTHS[::-1]),
    "stack.dm5": lambda path: write_dm(path, FRAMES, LENGTHS),
    "director.dm4": lambda path: write_director(path, FRAMES, (5000, 9000)),
    "director.dm5": lambda path: write_director(path, FRAMES, (5000, 9000)),
    "velox.emd": lambda path: velox(path, FRAMES),
    "turned.nxs": turned,
    "x_master.h5": master,
    "movie.zarr": lambda path: small_zarr(path, FRAMES),
    "movie.raw": lambda path: path.write_bytes(FRAMES.tobytes()),
    "small.ser": lambda path: write_ser(path, FRAMES, planned=7),
    "large.ser": lambda path: write_ser(path, FRAMES, version=0x0220, axes=[(5, 0.5, "Time", "s")]),
    "first.tvips": lambda path: write_tvips(path, FRAMES, version=1),
    "second.tvips": lambda path: write_tvips(path, FRAMES),
    "three.seq": lambda path: write_seq(path, FRAMES.astype("u1"), version=3),
    "six.seq": lambda path: write_seq(path, FRAMES, version=6),
    "processed.mib": lambda path: write_mib(path, FRAMES),
    "quad.mib": lambda path: write_mib(path, FRAMES[:, :40, :32], raw=12, layout="2x2"),
    "bits.mib": lambda path: write_mib(path, np.repeat(FRAMES[:, :, :32], 2, 2) & 1, raw=1),
}
HOSTILE = (0, 1, 2, 3, 7, 0x7F, 0x80, 0xFF, 0x7FFF, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 1 << 40, (1 << 63) - 1)
DIGITS = (b"0", b"-1", b"65536", b"4294967296", b"99999999999999999999", b"1e400", b"nan", b"9" * 5000)


def mutated(data: bytes, seed: int) -> bytes:
    """Change a few places of a file, most of them near its beginning, as damage and malice do."""
    rng = random.Random(seed)
    found = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        at = rng.randrange(min(len(found), rng.choice((128, 600, 4000, len(found)))))
        kind = rng.randrange(8)
        if kind == 0:
            found[at] = rng.randrange(256)
        elif kind == 1:
            found[at] ^= 1 << rng.randrange(8)
        elif kind in (2, 3):
            width = rng.choice((1, 2, 4, 8))
            at -= at % width
            number = (rng.choice(HOSTILE) & ((1 << 8 * width) - 1)).to_bytes(width, rng.choice(("little", "big")))
            found[at : at + width] = number
        elif kind == 4 and (numbers := list(re.finditer(rb"\d+", found[:8000]))):
            place = rng.choice(numbers).span()
            found[slice(*place)] = rng.choice(DIGITS)
        elif kind == 5:
            other, length = rng.randrange(len(found)), rng.randrange(1, 64)
            found[at : at + length] = found[other : other + length]
        elif kind == 6 and rng.random() < 0.4:
            del found[rng.randrange(len(found) // 2, len(found)) :]
        elif kind == 7 and rng.random() < 0.4:
            found[at:at] = bytes(rng.randrange(256) for _ in range(rng.randrange(1, 40)))
    return bytes(found)


INSIDE = {"links.h5": "::/entry/data"}


def outcome(path: Path) -> str:
    """Open a file and read its first and last frame: ok, opened (a frame is refused) or refused.

    Other errors than ours go through.
    """
    text, source = "", None
    try:
        source = open_source(f"{path}{INSIDE.get(path.name, '')}", DECLARED)
        for k in {0, source.shape[0] - 1}:
            assert source.read(k, k + 1).shape == (1, *source.shape[1:])
        source.read_into(0, np.empty((1, *source.shape[1:]), source.dtype))
    except TractError as error:
        text = str(error)
    assert not text or path.name in text
    assert len(text) < 4000
    return "ok" if not text else "opened" if source else "refused"


@pytest.mark.parametrize("name", BASES)
def test_mutated_files_give_frames_or_one_of_our_errors(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    BASES[name](path)
    whole = path.read_bytes()
    assert outcome(path) == "ok"
    results = []
    for seed in range(CASES):
        path.write_bytes(mutated(whole, seed))
        results.append(outcome(path))
    assert results.count("ok") >= 1
