"""Small files of the HDF5 family and of Zarr, written here."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import zarr

FRAMES = np.random.default_rng(3).poisson(9, (5, 40, 36)).astype("u2")


def velox_text(frame: int = 0, **changes: Any) -> bytes:
    said = {
        "Stage": {"AlphaTilt": str(0.1 * frame), "BetaTilt": "0"},
        "Scan": {"ScanSize": {"width": "36", "height": "40"}, "FrameTime": "0.25"},
        "Detectors": {"Detector-0": {"DetectorName": "HAADF", "DetectorType": "ScanningDetector"}},
        "BinaryResult": {
            "Detector": "HAADF",
            "PixelSize": {"width": "2e-11", "height": "2e-11"},
            "PixelUnitX": "m",
            "PixelUnitY": "m",
        },
        "CustomProperties": {"Holder.Temperature": {"type": "double", "value": str(20 + frame)}},
    }
    return json.dumps(said | changes).encode()


def velox(
    path: Path, frames: np.ndarray = FRAMES, depth: int = 1, name: str = "a1", mode: str = "w", **changes: Any
) -> Path:
    """A Velox file: (y, x, frame), and a JSON text a frame."""
    with h5py.File(path, mode) as file:
        group = file.create_group(f"Data/Image/{name}")
        group.create_dataset("Data", data=frames.transpose(1, 2, 0), chunks=(*frames.shape[1:], depth))
        texts = np.zeros((4000, len(frames)), "u1")
        for k in range(len(frames)):
            said = velox_text(k, **changes)
            texts[: len(said), k] = np.frombuffer(said, "u1")
        group.create_dataset("Metadata", data=texts, chunks=(4000, 1))
        group["FrameLookupTable"] = np.arange(len(frames), dtype="u4")
    return path


def emd(path: Path, data: np.ndarray, dims: list[tuple[str, str, Any]], first: int = 1, **attributes: Any) -> Path:
    """An EMD group; a dim is its name, unit and places."""
    with h5py.File(path, "w", libver="latest") as file:
        group = file.create_group("data/movie")
        group.attrs.update({"emd_group_type": 1} | attributes)
        group["data"] = data
        for k, (name, unit, places) in enumerate(dims):
            group[f"dim{k + first}"] = places
            group[f"dim{k + first}"].attrs.update({"name": name, "units": unit})
    return path


def hyperspy(path: Path, data: np.ndarray, axes: list[tuple[str, Any, float, bool]]) -> Path:
    """A HyperSpy file; an axis is its name, unit, scale and whether it is one of navigation."""
    with h5py.File(path, "w") as file:
        group = file.create_group("Experiments/x")
        group.create_dataset("data", data=data, chunks=(1, *data.shape[1:]), compression="gzip")
        for k, (name, unit, scale, navigate) in enumerate(axes):
            said = {"name": name, "units": unit, "scale": scale, "navigate": navigate, "size": data.shape[k]}
            group.create_group(f"axis-{k}").attrs.update(said)
        group["learning_results/factors"] = np.zeros((3,) * data.ndim)
    return path


def nexus(path: Path, data: np.ndarray, axes: list[str], **places: Any) -> Path:
    """An NXdata group; ``places`` are the values of an axis and its unit."""
    with h5py.File(path, "w") as file:
        group = file.create_group("entry/data")
        group.attrs.update({"NX_class": "NXdata", "signal": "counts", "axes": axes})
        group["counts"], group["errors"] = data, data * 0.5
        for name, (values, unit) in places.items():
            group[name] = values
            group[name].attrs["units"] = unit
    return path


def dectris(folder: Path, frames: np.ndarray = FRAMES, per_file: int = 2, stem: str = "run", **filters: Any) -> Path:
    """A master file and its data files."""
    master = folder / f"{stem}_master.h5"
    with h5py.File(master, "w") as file:
        group = file.create_group("entry/data")
        group.attrs["NX_class"] = "NXdata"
        detector = file.create_group("entry/instrument/detector")
        for name, value, unit in (("frame_time", 2.0, "ms"), ("count_time", 1.9, "ms"), ("x_pixel_size", 75e-6, "m")):
            detector[name] = value
            detector[name].attrs["units"] = unit
        detector["detectorSpecific/nimages"], detector["detectorSpecific/ntrigger"] = np.uint64(len(frames)), 1
        mask = np.zeros(frames.shape[1:], "u4")
        mask[0, :3] = 1
        detector["pixel_mask"] = mask
        for number, first in enumerate(range(0, len(frames), per_file), start=1):
            part = frames[first : first + per_file]
            with h5py.File(folder / f"{stem}_data_{number:06d}.h5", "w") as data:
                data.create_dataset("entry/data/data", data=part, chunks=(1, *part.shape[1:]), **filters)
            group[f"data_{number:06d}"] = h5py.ExternalLink(f"{stem}_data_{number:06d}.h5", "/entry/data/data")
    return master


def array(place: Any, name: str, data: np.ndarray, chunks: tuple[int, ...] | None = None, **options: Any) -> Any:
    """A Zarr array in a group or at a path."""
    made = zarr.create_array(
        place, name=name or None, shape=data.shape, dtype=data.dtype, chunks=chunks or (1, *data.shape[1:]), **options
    )
    made[...] = data
    return made


def ome(path: Path, data: np.ndarray, axes: list[Any] | None, scale: list[float], version: int = 3) -> Path:
    """An OME-Zarr image with a second, binned level: 0.4 in Zarr 2, 0.5 in Zarr 3."""
    root = zarr.open_group(str(path), mode="w", zarr_format=version)
    for level, pixels in (("0", data), ("1", data[..., ::2, ::2])):
        array(root.store, level, pixels, (1,) * (data.ndim - 2) + (16, 20), zarr_format=version)
    steps = [{"path": "0", "coordinateTransformations": [{"type": "scale", "scale": scale}]}, {"path": "1"}]
    image = {"datasets": steps} | ({} if axes is None else {"axes": axes})
    root.attrs.update({"ome": {"version": "0.5", "multiscales": [image]}} if version == 3 else {"multiscales": [image]})
    return path


def zspy(path: Path, data: np.ndarray, axes: list[tuple[str, str, float, bool]]) -> Path:
    """HyperSpy's Zarr file."""
    root = zarr.open_group(str(path), mode="w", zarr_format=2)
    group = root.create_group("Experiments").create_group("x")
    array(root.store, "Experiments/x/data", data, (2, 20, 36), zarr_format=2)
    for k, (name, unit, scale, navigate) in enumerate(axes):
        group.create_group(f"axis-{k}").attrs.update(
            {"name": name, "units": unit, "scale": scale, "navigate": navigate}
        )
    return path


def zipped(folder: Path, path: Path) -> Path:
    """The ZIP file of a store."""
    made = shutil.make_archive(str(path.with_suffix("")), "zip", folder)
    return Path(made).rename(path)


def small_zarr(path: Path, frames: np.ndarray = FRAMES) -> None:
    """A zipped store in one file, uncompressed; a curve lies before the movie."""
    root = zarr.open_group(zarr.storage.ZipStore(path, mode="w"), mode="w", zarr_format=2)
    array(root.store, "curve", np.arange(600.0), (600,), zarr_format=2, compressors=None)
    array(root.store, "data", frames, zarr_format=2, compressors=None)
    root.store.close()
