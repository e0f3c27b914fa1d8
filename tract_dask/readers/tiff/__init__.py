"""TIFF in the flavours that microscopes and programs write; pages are decoded by tifffile where they are compressed."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from ...errors import SourceError
from ...settings.run import SourceSettings
from ..beside import known_beside, merged
from ..blocks import BlockSource, flip
from ..checks import (
    DAMAGE,
    FILLING,
    Frames,
    Permit,
    checked_claim,
    checked_dtype,
    checked_file,
    checked_shape,
    maybe_packed,
    truncated,
    unaccounted,
    widened,
    words,
)
from ..source import Source
from .codecs import CODECS, PART_BYTES, check_codestreams
from .metadata import Description, parse_description
from .pages import ORIENTATION, SUB_PAGES, Page, Tags, walk

logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # what it warns of is an error here, with a remedy


@dataclass(frozen=True, kw_only=True, eq=False)
class PagedSource(Source):
    """Compressed, tiled or scattered pages.

    Attributes
    ----------
    directories
        The places of their tags.
    flipped
        Bits that are the other way round than meant.
    """

    directories: NDArray[np.int64]
    flipped: int = 0

    @property
    def one_by_one(self) -> bool:
        """Whether frames that are read one by one take no longer than many at once."""
        return True

    def _read(self, start: int, stop: int) -> Frames:
        directories = self.directories[start:stop]
        frames = np.empty((len(directories), *self.shape[1:]), self.dtype)
        k = 0
        try:
            checked_file(self.files[0])
            with tifffile.TiffFile(self.files[0]) as tiff:
                for k, directory in enumerate(directories.tolist()):
                    frames[k] = widened(decoded(tiff, directory, start + k, self.shape[1:]), self.dtype)
        except DAMAGE as error:
            raise undecoded(start + k, self.path, error) from error
        flip(frames, self.flipped)
        return frames


def decoded(tiff: tifffile.TiffFile, directory: int, number: int, shape: tuple[int, ...]) -> Frames:
    """Return the page whose tags are at a place, decoded; ``shape`` is that of the movie's pages."""
    tiff.filehandle.seek(directory)
    page = tifffile.TiffPage(tiff, index=number)
    check_codestreams(tiff.filehandle, page, tiff.filehandle.path)
    frame: Frames = page.asarray(maxworkers=1).reshape(shape)
    return frame


def undecoded(number: int, where: str, error: Exception) -> SourceError:
    """Return the error for a page that is damaged."""
    return SourceError(
        f"page {number} (counted from 0) cannot be decoded",
        where,
        got=words(error),
        remedy="Export the movie again, uncompressed if that helps",
    )


def open_tiff(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> Source:
    """Open a TIFF whose pages, all of one shape and type, are the frames.

    Raises
    ------
    SourceError
        Where the file is damaged or cut short, pages differ, or pixels are colours or complex.
    """
    every, tags, tag_bytes = walk(path)
    stored_bytes = tag_bytes + sum(page.n_stored for page in every)
    pages = [page for page in every if not page.reduced]
    if not pages:
        raise SourceError(
            "the movie has no frames", str(path), "at least one page", "none", "Check how it was exported"
        )
    _check_first(pages[0], path)
    description = parse_description(tags, path, pages)
    if description.order is not None and len(pages) >= len(description.order):
        pages = _ordered(pages, description.order, path)
    _check_alike(pages, path)
    n_frames = max(description.frames or 0, len(pages))
    shape = checked_shape((n_frames, *pages[0].shape), str(path))
    offsets = _offsets(pages, n_frames, description, path)
    dtype, flipped, notes = _meaning(pages[0], description, path)
    stored_bytes += (n_frames - len(pages)) * pages[0].n_stored if n_frames > len(pages) else 0
    notes += _turned(tags, path) + maybe_packed(dtype, pages[0].shape, path.name)
    notes += _beside(sum(page.reduced for page in every), tags, path, stored_bytes, pages[0].n_stored)
    metadata = replace(description.metadata, notes=(*description.metadata.notes, *notes))
    common: dict[str, Any] = {
        "path": str(path),
        "files": (path,),
        "format": description.format,
        "metadata": merged(metadata, known_beside(path, n_frames, permit), "the file next to it"),
        "flipped": flipped,
    }
    if all(page.plain for page in pages):
        return BlockSource(**common, shape=shape, dtype=dtype, offsets=offsets, stored=pages[0].stored)
    _check_claims(pages, path)
    directories = np.array([page.directory for page in pages], np.int64)
    return PagedSource(**common, shape=shape, dtype=dtype, directories=directories)


_COLOURS = {2: "RGB colours", 5: "CMYK colours", 6: "YCbCr colours", 8: "CIE L*a*b* colours"}
_RAW_COLOURS = 32803
_PALETTE = 3


def _check_first(page: Page, path: Path) -> None:
    """Refuse colours, by their names."""
    colours = _COLOURS.get(page.photometric, "several values each, as in a colour image")
    if page.photometric == _RAW_COLOURS or len(page.shape) > 2:
        several = ("are " if page.photometric in _COLOURS else "have ") + colours
        several += " with transparency" if page.photometric == 2 and page.shape[2:] == (4,) else ""
        raise SourceError(
            f"the pixels {'lie behind a mosaic of colour filters' if len(page.shape) == 2 else several}",
            str(path),
            "one intensity a pixel",
            f"{' x '.join(map(str, page.shape[2:])) or '1'} values a pixel",
            "Save the movie as greyscale, from the data and not from the screen",
        )
    checked_dtype(page.stored, str(path))


def _meaning(page: Page, description: Description, path: Path) -> tuple[np.dtype[Any], int, tuple[str, ...]]:
    """Return the type of the pixels that are meant, which bits are stored the other way round, and notes on it."""
    dtype = checked_dtype(page.stored, str(path))
    where = path.name
    if page.photometric == _PALETTE:
        note = f"{where}: its pixels are numbers of a table of colours (palette); they are read as stored"
        return dtype, 0, (note,)
    if description.signed:
        return np.dtype(f"i{dtype.itemsize}"), 1 << (8 * dtype.itemsize - 1), ()
    if page.photometric != 0:
        return dtype, 0, ()
    if description.as_shown or dtype.kind == "f":
        return dtype, 0, (f"{where} is shown with white for 0 (MinIsWhite); its numbers are read as stored",)
    n_bits = 8 * dtype.itemsize if dtype.kind == "i" else page.n_bits
    return dtype, (1 << n_bits) - 1, (f"{where} stores white as 0 (MinIsWhite); its numbers are turned over",)


def _beside(n_reduced: int, tags: Tags, path: Path, stored_bytes: int, frame_bytes: int) -> tuple[str, ...]:
    """Return notes on what a file holds beside its pages; ``stored_bytes`` are those of pages and tags."""
    notes: tuple[str, ...] = ()
    if n_reduced:
        notes = (f"{path.name}: {n_reduced} of its pages are small copies (thumbnails) and are not read",)
    if SUB_PAGES in tags:
        return (*notes, f"{path.name}: its pages have further pages below them (SubIFDs), which are not read")
    return notes + unaccounted(path.name, path.stat().st_size - stored_bytes, frame_bytes, min(frame_bytes, FILLING))


def _turned(tags: Tags, path: Path) -> tuple[str, ...]:
    orientation = (tags.get(ORIENTATION) or (1,))[0]
    if not 2 <= orientation <= 8:
        return ()
    return (f"{path.name} is to be shown turned or mirrored (orientation {orientation}); it is read as it is stored",)


def _check_claims(pages: list[Page], path: Path) -> None:
    """Check what pages that are decoded take, before they are."""
    size = path.stat().st_size
    for number, page in enumerate(pages):
        n_bytes = page.shape[0] * page.shape[1] * page.stored.itemsize
        checked_claim(n_bytes, size, str(path), f"page {number} (counted from 0)")
        if page.compression not in CODECS:
            raise SourceError(
                f"the compression of page {number} (counted from 0) is not read",
                str(path),
                f"none, or one of {', '.join(sorted(set(CODECS.values()) - {'none'}))}",
                f"number {page.compression}",
                "Export the movie again, uncompressed if that helps",
            )
        if page.segment_bytes > PART_BYTES + 2 * n_bytes:
            raise SourceError(
                f"the strips or tiles of page {number} (counted from 0) are far larger than the page",
                str(path),
                f"at most {PART_BYTES + 2 * n_bytes:,} bytes",
                f"{page.segment_bytes:,} bytes",
                "The file is damaged: export the movie again",
            )


def _check_alike(pages: list[Page], path: Path) -> None:
    first = pages[0]
    for number, page in enumerate(pages):
        if (page.shape, page.stored, page.photometric) != (first.shape, first.stored, first.photometric):
            raise SourceError(
                f"page {number} (counted from 0) differs from the first page",
                str(path),
                _words(first),
                _words(page),
                "Take that page out, or export the frames alone",
            )


def _words(page: Page) -> str:
    kind = {0: ", white is 0", 1: "", _PALETTE: ", a palette"}.get(page.photometric, f", colours {page.photometric}")
    return f"{' x '.join(map(str, page.shape))} {page.stored.newbyteorder('=')}{kind}"


def _ordered(pages: list[Page], order: tuple[int, ...], path: Path) -> list[Page]:
    if min(order) < 0 or max(order) >= len(pages):
        raise SourceError(
            "the OME description names pages that the file has not",
            str(path),
            f"page numbers below {len(pages)}",
            str(max(order)),
            "Export the movie again",
        )
    return [pages[number] for number in order]


def _offsets(pages: list[Page], n_frames: int, description: Description, path: Path) -> NDArray[np.int64]:
    """Return where each frame's data begin.

    Programs write one page only for movies over 4 GB, whose other frames simply follow the first.
    """
    if n_frames == len(pages):
        return np.array([page.offset for page in pages], np.int64)
    if len(pages) > 1 or not pages[0].plain or not description.one_run:
        raise SourceError(
            "the file ends before its last page",
            str(path),
            f"{n_frames} pages, as its description says",
            str(len(pages)),
            "The copy or export was cut short: make it again",
        )
    frame_bytes = pages[0].end - pages[0].offset
    end, size = pages[0].offset + n_frames * frame_bytes, path.stat().st_size
    if size < end:
        n_whole = (size - pages[0].offset) // frame_bytes
        raise truncated(str(path), f"in frame {n_whole} of {n_frames}, which its description promises", end, size)
    return pages[0].offset + frame_bytes * np.arange(n_frames, dtype=np.int64)
