"""The movie store as it is made and finished."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numpy.typing import NDArray

from ...readers.source import SourceMetadata
from ...settings.run import MetadataSettings
from ...store import datasets, disk, files, schema
from ...store.layout import LEVEL_DTYPE, Layout
from ...store.metadata import attributes, forget, update_attributes
from ...store.ome import AXES, CHANGING, frame_array, write_metadata
from ...store.pixels import GROUP, NO_PIXELS, Pixels, nodes_of
from ...store.shard_files import CHUNK_KEYS, MARKED, Grid, codecs


def update_metadata(path: Path, metadata: SourceMetadata, **more: Any) -> None:
    """Write pixel size, frame time, dose and gain into a movie store, if they differ: coordinates, scales, attributes.

    ``more`` are attributes of the store that are written with them.

    Raises
    ------
    StoreError
        Where it cannot be written.
    """
    present, now = attributes(path), quantities(metadata) | more
    cut_off = present.pop(CHANGING, False)
    if cut_off or any(present.get(name) != value for name, value in now.items()):
        mark: dict[str, Any] = {CHANGING: True}
        with files.disk_errors(path):
            update_attributes(path, **mark)  # coordinates and root change one after the other
            write_metadata(path, present | now)


def create(path: Path, layout: Layout, codec: str, about: dict[str, Any], known: SourceMetadata) -> None:
    """Make the store with all its arrays, still empty: whole or not at all."""
    aside = disk.aside(path)
    files.remove(aside)
    zarr.create_group(aside, zarr_format=3)
    zarr.create_group(aside / "binned", zarr_format=3)
    _create_array(aside / "0", layout.grid(), layout.dtype, codec)
    for factor in layout.bins:
        _create_array(aside / "binned" / str(factor), layout.grid(factor), LEVEL_DTYPE, codec)
    for axis, length in zip(AXES, layout.shape, strict=True):
        _create_vector(aside / axis, length, axis, "float64")
    for variable in schema.STATISTICS.values():
        _create_vector(aside / variable.name, layout.shape[0], "t", variable.dtype, variable.attributes)
    for name, of in known.along_frames.items():
        said = schema.FRAME_VALUES[name].attributes if name in schema.FRAME_VALUES else {"units": of.units}
        _create_vector(aside / frame_array(name), layout.shape[0], "t", "float64", said)
        datasets.overwrite_array(aside / frame_array(name), of.values)
    plan = {
        "kind": "movie",
        "complete": False,
        MARKED: True,
        "shape": layout.shape,
        "dtype": layout.dtype.name,
        "frames_per_shard": layout.frames_per_shard,
        "chunk": layout.chunk,
        "bins": layout.bins,
        "frame_values": list(known.along_frames),
        "part": known.part and asdict(known.part),
    }
    write_metadata(aside, about | plan | quantities(known))
    disk.place_folder(aside, path)


def _create_array(path: Path, grid: Grid, dtype: np.dtype[Any], codec: str) -> zarr.Array[Any]:
    return zarr.create_array(
        path,
        shape=grid.shape,
        chunks=grid.chunk,
        shards=grid.shard,
        dtype=dtype,
        compressors=codecs(codec),
        chunk_key_encoding=CHUNK_KEYS,
        fill_value=0,
        dimension_names=AXES,
        zarr_format=3,
    )


def _create_vector(path: Path, length: int, axis: str, dtype: str, attributes: dict[str, Any] | None = None) -> None:
    zarr.create_array(
        path,
        shape=(length,),
        chunks=(length,),
        dtype=dtype,
        compressors=codecs("zstd"),
        chunk_key_encoding=CHUNK_KEYS,
        fill_value=0,
        dimension_names=(axis,),
        attributes=attributes,
        zarr_format=3,
    )


def finalise(
    path: Path, along_frames: dict[str, NDArray[np.float64]], known: SourceMetadata, pixels: Pixels = NO_PIXELS
) -> None:
    """Write arrays (frames,) such as the statistics, the pixels without data and the metadata; say: it is complete."""
    present = attributes(path)
    with files.disk_errors(path):
        if present["complete"]:  # it is repaired
            forget(path, present.get("arrays", ()))
        for name, values in along_frames.items():
            datasets.overwrite_array(path / name, values)
        left_out = pixels.write(path, present["shape"][1:])
        written = (*along_frames, *nodes_of({GROUP: left_out}))
        disk.sync_folders(path, written)
        write_metadata(path, present | quantities(known) | {GROUP: left_out, "complete": True}, written)


def quantities(metadata: SourceMetadata | MetadataSettings) -> dict[str, Any]:
    """Return pixel size, frame time, dose and gain by their names."""
    return {name: getattr(metadata, name) for name in schema.CALIBRATION}
