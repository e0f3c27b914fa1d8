"""The tags of a DM5 file, which is HDF5: groups are groups of tags, attributes their values."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from ...errors import SourceError
from ..checks import DAMAGE, Permit
from ..hdf5.links import Access, opened
from .image import COLOURS, COMPLEX, TYPES
from .tags import Array, Tags, short

_MOST_TAGS, _DEEPEST, _LONGEST = 50_000, 64, 1 << 16

_CODES = {name: code for code, name in TYPES.items()}


def read_dm5(path: Path, permit: Permit | None) -> tuple[Tags, dict[int, np.dtype[Any]]]:
    """Read the tags of a DM5 file, and the types of its images' pixels by the number of the image.

    Raises
    ------
    SourceError
        Where the file is damaged, or has too many tags.
    """
    with opened(path, Access(permit)) as file:
        walk = _Walk(str(path))
        tags = walk.group(file, 0)
        types = {}
        for name, dataset in _pixels(file):
            entry = tags.setdefault("ImageList", {}).setdefault(name, {}).setdefault("ImageData", {})
            entry.update(_described(entry, dataset))
            types[int(name[1:-1])] = dataset.dtype
    return tags, types


def _pixels(file: Any) -> Iterator[tuple[str, Any]]:
    """Yield the name in ImageList, and the data set of each image."""
    for name in _children(file["ImageList"]) if "ImageList" in _children(file) else ():
        group = file["ImageList"][name]
        if name[:1] == "[" and name[1:-1].isdecimal() and "ImageData" in _children(group):
            data = group["ImageData"]
            if "Data" in _children(data) and isinstance(data["Data"], h5py.Dataset):
                yield name, data["Data"]


def _described(tags: Tags, dataset: Any) -> Tags:
    """Return the tags of an image as its data set has them: where both say something, the data set is right."""
    stored, shape = dataset.dtype, dataset.shape or ()
    found = {
        "Data": Array(0, dataset.size * stored.itemsize if dataset.size else 0),
        "Dimensions": {f"[{k}]": int(size) for k, size in enumerate(reversed(shape))},
        "PixelDepth": stored.itemsize,
    }
    if tags.get("DataType") in COLOURS:
        return found
    code = _CODES.get(stored.str[1:]) or {"c": COMPLEX[0], "V": COLOURS[0]}.get(stored.kind)
    return found | ({"DataType": code} if code else {})


class _Walk:
    """Goes along the groups of a file; of links only hard ones are followed."""

    def __init__(self, where: str) -> None:
        self.where = where
        self.n_tags = 0
        self.seen: set[object] = set()

    def group(self, group: Any, depth: int) -> Tags:
        """Return the attributes of a group, and those of the groups below it."""
        found: Tags = {}
        self._count(len(group.attrs) + len(group), depth)
        for name in group.attrs:
            try:
                found[name] = _value(group, name)
            except DAMAGE:
                continue  # an attribute of a type that nobody reads here
        for name in _children(group):
            item = group[name]
            if isinstance(item, h5py.Group) and self._is_new(item):
                found[name] = self.group(item, depth + 1)
        return found

    def _is_new(self, group: Any) -> bool:
        """Tell whether a group was not looked at: hard links may lead to one from several places, and in circles."""
        place = h5py.h5o.get_info(group.id).addr
        known = place in self.seen
        self.seen.add(place)
        return not known

    def _count(self, count: int, depth: int) -> None:
        self.n_tags += count
        if self.n_tags > _MOST_TAGS or depth > _DEEPEST:
            raise SourceError(
                "the tags are nested too deeply" if depth > _DEEPEST else "the file has too many tags",
                self.where,
                f"at most {_DEEPEST} groups in one another and {_MOST_TAGS:,} tags",
                "more",
                "The file is damaged: make the copy or the export again",
            )


def _children(group: Any) -> list[str]:
    """Return the names in a group that are neither links to other places nor to other files."""
    if not isinstance(group, h5py.Group):
        return []
    return [name for name in group if isinstance(group.get(name, getlink=True), h5py.HardLink)]


def _value(group: Any, name: str) -> Any:
    """Return an attribute as a number or a text where it is one; None for others."""
    attribute = group.attrs.get_id(name)
    if int(np.prod(attribute.shape, dtype=object)) > _LONGEST:
        return None
    found = group.attrs[name]
    if isinstance(found, bytes):
        return found.decode(errors="replace")
    if isinstance(found, np.ndarray) and found.dtype.kind == "u" and found.dtype.itemsize == 2 and found.ndim == 1:
        return found.astype("<u2").tobytes().decode("utf-16-le", "replace").rstrip("\0")
    if isinstance(found, np.ndarray) and found.size == 1:
        found = found.reshape(-1)[0]
    if isinstance(found, np.generic):
        found = short(float(found)) if found.dtype == np.float32 else found.item()
    return found.decode(errors="replace") if isinstance(found, bytes) else found
