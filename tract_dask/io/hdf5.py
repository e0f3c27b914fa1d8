"""HDF5 data sets, named as ``file.h5::/path/in/file``; HyperSpy's .hspy among them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ..errors import SourceError
from ..settings import SourceSettings
from .source import Frames, Source, SourceMetadata, checked_dtype, checked_shape, unreadable
from .units import square_pixel, to_pm, to_seconds


@dataclass(frozen=True, kw_only=True, eq=False)
class Hdf5Source(Source):
    """A data set in an HDF5 file; ``inner`` is its path there."""

    inner: str

    @property
    def inside(self) -> str:
        """The path of the frames inside their file."""
        return self.inner

    def read(self, start: int, stop: int) -> Frames:
        """Return frames ``start`` to ``stop`` (not included) as a new array (frames, y, x)."""
        try:
            with h5py.File(self.files[0], "r") as file:
                dataset = file[self.inner]
                selection = dataset[start:stop] if dataset.ndim == 3 else dataset[()][None][start:stop]
        except OSError as error:
            raise unreadable(self.path, error, f"frames {start} to {stop - 1} cannot be read") from error
        return np.ascontiguousarray(selection, self.dtype)


def open_hdf5(path: Path, inner: str, settings: SourceSettings) -> Hdf5Source:
    """Open a data set of an HDF5 file; where only one has three axes, ``inner`` may be empty.

    Raises
    ------
    SourceError
        Where the file is damaged, the path leads nowhere or to several data sets, or the data are not a movie.
    """
    try:
        with h5py.File(path, "r") as file:
            dataset = _find(file, inner, path)
            where = f"{path}::{dataset.name}"
            _check_filters(dataset, where)
            return Hdf5Source(
                path=str(path),
                files=(path,),
                format="HDF5",
                shape=checked_shape(dataset.shape, where),
                dtype=checked_dtype(dataset.dtype, where),
                metadata=_metadata(dataset),
                inner=dataset.name,
            )
    except OSError as error:
        raise SourceError(
            "the file cannot be opened as HDF5",
            str(path),
            got=" ".join(str(error).split()),
            remedy="Check the copy: it may be cut short, still being written, or of another format",
        ) from error


def _find(file: Any, inner: str, path: Path) -> Any:
    """Return the data set that ``inner`` names, or the only movie below it."""
    target = file.get(inner) if inner else file
    if isinstance(target, h5py.Dataset):
        return target
    found: list[Any] = []
    file.visititems(lambda name, item: found.append(item) if isinstance(item, h5py.Dataset) and item.ndim else None)
    inside = [] if target is None else [item for item in found if item.name.startswith(target.name.rstrip("/") + "/")]
    numbers = [item for item in inside if item.dtype.kind in "iufc"]
    movies = [item for item in numbers if item.ndim == 3] or [item for item in numbers if item.ndim == 2]
    if len(movies) == 1:
        return movies[0]
    listing = ", ".join(f"{item.name} {item.shape} {item.dtype}" for item in (movies or found)[:20])
    raise SourceError(
        "there is nothing under this path"
        if target is None
        else f"there are {len(movies)} data sets that could be the movie",
        f"{path}::{inner}" if inner else str(path),
        "the path of one data set with axes (frames, y, x)",
        f"a file that holds {listing}" if listing else "a file without data sets",
        f"Name it, for example {path.name}::{movies[0].name}" if movies else "Name one of those, or check the file",
    )


def _check_filters(dataset: Any, where: str) -> None:
    properties = dataset.id.get_create_plist()
    for number in range(properties.get_nfilters()):
        code, _, _, name = properties.get_filter(number)
        if not h5py.h5z.filter_avail(code):
            raise SourceError(
                "the data are compressed by a filter that is not installed",
                where,
                "filters that this HDF5 library has, such as gzip or lzf",
                f"filter {code} ({name.decode(errors='replace')})",
                "Install its plugin where HDF5_PLUGIN_PATH points, or repack the file with h5repack -f GZIP=1",
            )


def _metadata(dataset: Any) -> SourceMetadata:
    """Return the calibration of HyperSpy's axes, or of attributes such as pixel_size_nm and frame_time_ms."""
    axes = [_axis(dataset.parent, number) for number in range(dataset.ndim)]
    pixel, notes = square_pixel(to_pm(*axes[-1]), to_pm(*axes[-2]))
    seconds = to_seconds(*axes[0]) if dataset.ndim == 3 else None
    for item in (dataset.file, dataset.parent, dataset):
        for name, value in item.attrs.items():
            if (match := re.fullmatch(r"(pixel_size|frame_time)_([^_]+)", name)) and np.size(value) == 1:
                convert, number = (to_pm if match[1] == "pixel_size" else to_seconds), _number(value)
                if match[1] == "pixel_size":
                    pixel = convert(number, match[2]) or pixel
                else:
                    seconds = convert(number, match[2]) or seconds
    return SourceMetadata(pixel, seconds, notes=notes)


def _axis(group: Any, number: int) -> tuple[float, str]:
    """Return scale and unit of a HyperSpy axis; the unit is empty where there is no such axis."""
    attributes = group[f"axis-{number}"].attrs if f"axis-{number}" in group else {}
    unit = attributes.get("units", "")
    return _number(attributes.get("scale", np.nan)), unit.decode() if isinstance(unit, bytes) else str(unit)


def _number(value: Any) -> float:
    try:
        return float(np.asarray(value).item())
    except (TypeError, ValueError):
        return float("nan")
