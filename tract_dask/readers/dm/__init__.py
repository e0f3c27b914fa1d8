"""DigitalMicrograph files: DM3 and DM4, and DM5, which is HDF5; each holds images and stacks."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...errors import SourceError
from ...settings.run import SourceSettings
from ..blocks import open_block
from ..checks import Frames, Permit, checked_dtype, checked_shape, open_binary, truncated, untested, widened
from ..hdf5 import open_hdf5
from ..source import FrameValues, Source, SourceMetadata
from .calibration import calibration, stage_tilt, started
from .dm5 import read_dm5
from .image import Image, chosen, frame_axis, stored_type
from .tags import Array, TagFile, Tags, entries, read_tags

_HDF5 = b"\x89HDF\r\n\x1a\n"
_AFTER = 8
"""Bytes of zeros that end a DM3 or DM4 file."""


@dataclass(frozen=True)
class Document:
    """The tags of a file.

    Attributes
    ----------
    name
        DM3, DM4 or DM5.
    order
        Of bytes in pixels, ``<`` or ``>``.
    types
        Of a DM5 file: the types of the images' pixels, by the number of the image.
    notes
        What the user should know.
    """

    path: Path
    name: str
    tags: Tags
    order: str
    types: Mapping[int, np.dtype[Any]] = field(default_factory=dict)
    notes: tuple[str, ...] = ()

    def stored(self, image: Image) -> np.dtype[Any]:
        """Return the type of an image's pixels in the file; raises a SourceError where they are no intensities."""
        stored = stored_type(image, self.order)
        return self.types.get(image.number, stored)


@dataclass(frozen=True, kw_only=True, eq=False)
class CrossSource(Source):
    """A stack in which the frames are not the slowest axis.

    Attributes
    ----------
    lengths
        Of the axes as stored, the slowest first.
    frame_axis
        Which of them counts the frames.
    stored, offset
        Type and place of the pixels.
    """

    lengths: tuple[int, ...]
    frame_axis: int
    stored: np.dtype[Any]
    offset: int

    def _read(self, start: int, stop: int) -> Frames:
        size, needed = self.files[0].stat().st_size, self.offset + self.stored.itemsize * math.prod(self.lengths)
        if size < needed:  # to touch a map beyond its file would end the process
            raise truncated(self.path, "before the frames that it held when it was opened", needed, size)
        with open_binary(self.files[0]) as file:
            stack = np.memmap(file, self.stored, "r", self.offset, self.lengths)
        return widened(np.array(np.moveaxis(stack, self.frame_axis, 0)[start:stop], order="C"), self.dtype)


def read_document(path: Path, permit: Permit | None) -> Document:
    """Read the tags of a DM3, DM4 or DM5 file.

    Raises
    ------
    SourceError
        Where it is damaged, or of another format.
    """
    with open_binary(path) as file:
        is_hdf5 = file.read(len(_HDF5)) == _HDF5
    if is_hdf5:
        tags, types = read_dm5(path, permit)
        return Document(path, "DM5", tags, "<", types, (untested("DM5", path.name),))
    found = read_tags(path)
    return Document(path, f"DM{found.version}", found.tags, found.order, notes=_of_tags(found, path))


def _of_tags(found: TagFile, path: Path) -> tuple[str, ...]:
    """Return notes on what of a file is not read."""
    after = path.stat().st_size - found.end - _AFTER
    notes = []
    if after > 0:
        notes.append(f"{path.name}: {after:,} bytes after its last tag are not read")
    if found.lost:
        notes.append(f"{path.name}: these tags are damaged and were passed over: {', '.join(found.lost[:9])}")
    return tuple(notes)


def image_of(document: Document, inner: str) -> tuple[Image, tuple[str, ...]]:
    """Return the image that ``inner`` numbers, or the largest; and notes."""
    image, notes = chosen(document.tags, str(document.path), inner)
    return image, document.notes + notes


def open_image(
    document: Document, image: Image, notes: tuple[str, ...], settings: SourceSettings, permit: Permit | None
) -> Source:
    """Open an image, which is a movie of one frame, or a stack.

    Raises
    ------
    SourceError
        Where its pixels are no intensities, or it has more than three axes.
    """
    stored = document.stored(image)
    known = calibration(image)
    metadata = replace(known, notes=notes + known.notes)
    inside = str(image.number)
    n_left_out = len(entries(image.tags, "ImageData", "Dimensions")) - len(image.axes)
    if n_left_out > 0 and len(image.axes) > 2:
        passed = "an axis of length 1 is" if n_left_out == 1 else f"{n_left_out} axes of length 1 are"
        metadata = replace(metadata, notes=(*metadata.notes, f"{document.path.name}: {passed} passed over"))
    if len(image.axes) == 2:
        metadata = replace(metadata, start_s=started(image), along_frames=_tilt(image))
    if document.types:
        return _open_hdf5(document, image, metadata, settings, permit)
    data = image.tags["ImageData"]["Data"]
    if not isinstance(data, Array):
        raise SourceError("the image has no pixels", image.place, "an array", str(data)[:80], "Check how it was saved")
    lengths = tuple(axis.size for axis in reversed(image.axes))
    across = 2 - frame_axis(image) if len(lengths) == 3 else 0
    if across:
        return _open_across(document, lengths, across, stored, data.offset, metadata, inside)
    source = open_block(
        document.path, name=document.name, shape=lengths, stored=stored, offset=data.offset, metadata=metadata
    )
    return replace(source, inside=inside)


def _open_across(
    document: Document,
    lengths: tuple[int, ...],
    across: int,
    stored: np.dtype[Any],
    offset: int,
    metadata: SourceMetadata,
    inside: str,
) -> CrossSource:
    place = str(document.path)
    shape = checked_shape((lengths[across], *lengths[:across], *lengths[across + 1 :]), place)
    note = f"{document.path.name}: its frames are not its slowest axis; reading is slow"
    return CrossSource(
        path=place,
        files=(document.path,),
        format=document.name,
        shape=shape,
        dtype=checked_dtype(stored, place),
        metadata=replace(metadata, notes=(*metadata.notes, note)),
        inside=inside,
        lengths=lengths,
        frame_axis=across,
        stored=stored,
        offset=offset,
    )


def _open_hdf5(
    document: Document, image: Image, metadata: SourceMetadata, settings: SourceSettings, permit: Permit | None
) -> Source:
    if len(image.axes) == 3 and frame_axis(image) != 2:
        raise SourceError(
            "the frames of this DM5 stack are not its slowest axis",
            image.place,
            "axes x, y and time, from the fastest to the slowest",
            ", ".join(axis.unit or "no unit" for axis in image.axes),
            "Save it from DigitalMicrograph as .dm4",
        )
    source = open_hdf5(document.path, f"/ImageList/[{image.number}]/ImageData/Data", settings, permit)
    notes = metadata.notes + source.metadata.notes
    return replace(source, format="DM5", inside=str(image.number), metadata=replace(metadata, notes=notes))


def _tilt(image: Image) -> dict[str, FrameValues]:
    tilt = stage_tilt(image)
    return {} if tilt is None else {"stage_tilt": FrameValues(np.array([tilt]), "deg")}
