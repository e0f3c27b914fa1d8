"""TIFF in the flavours that microscopes and programs write; pages are decoded by tifffile where they are compressed."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from numpy.typing import NDArray

from ..errors import SourceError
from ..settings.run import SourceSettings
from .blocks import BlockSource
from .source import Frames, Permit, Source, checked_claim, checked_dtype, checked_shape, truncated, widened, words
from .tiff_codecs import CODECS, PART_BYTES, check_codestreams
from .tiff_metadata import Description, parse_description
from .tiff_pages import Page, walk

logging.getLogger("tifffile").setLevel(logging.CRITICAL)  # what it warns of is an error here, with a remedy

_DAMAGE = (OSError, ValueError, RuntimeError, LookupError, TypeError, ArithmeticError)
"""What tifffile and its codecs raise on damaged pages."""


@dataclass(frozen=True, kw_only=True, eq=False)
class PagedSource(Source):
    """Compressed, tiled or scattered pages; ``directories`` are the places of their tags."""

    directories: NDArray[np.int64]

    @property
    def one_by_one(self) -> bool:
        """Whether frames that are read one by one take no longer than many at once."""
        return True

    def _read(self, start: int, stop: int) -> Frames:
        directories = self.directories[start:stop]
        frames = np.empty((len(directories), *self.shape[1:]), self.dtype)
        k = 0
        try:
            with tifffile.TiffFile(self.files[0]) as tiff:
                for k, directory in enumerate(directories.tolist()):
                    tiff.filehandle.seek(directory)
                    page = tifffile.TiffPage(tiff, index=start + k)
                    check_codestreams(tiff.filehandle, page, self.path)
                    frames[k] = widened(page.asarray(maxworkers=1).reshape(self.shape[1:]), self.dtype)
        except _DAMAGE as error:
            raise SourceError(
                f"page {start + k} (counted from 0) cannot be decoded",
                self.path,
                got=words(error),
                remedy="Export the movie again, uncompressed if that helps",
            ) from error
        return frames


def open_tiff(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> Source:
    """Open a TIFF whose pages, all of one shape and type, are the frames.

    Raises
    ------
    SourceError
        Where the file is damaged or cut short, pages differ, or pixels are colours or complex.
    """
    pages, tags = walk(path)
    pages = [page for page in pages if not page.reduced]
    if not pages:
        raise SourceError(
            "the movie has no frames", str(path), "at least one page", "none", "Check how it was exported"
        )
    _check_first(pages[0], path)
    description = parse_description(tags, path, len(pages))
    if description.order is not None and len(pages) >= len(description.order):
        pages = _ordered(pages, description.order, path)
    _check_alike(pages, path)
    n_frames = max(description.frames or 0, len(pages))
    shape = checked_shape((n_frames, *pages[0].shape), str(path))
    dtype = checked_dtype(pages[0].stored, str(path))
    offsets = _offsets(pages, n_frames, description, path)
    common: dict[str, Any] = {
        "path": str(path),
        "files": (path,),
        "format": description.format,
        "metadata": description.metadata,
    }
    if all(page.plain for page in pages):
        return BlockSource(**common, shape=shape, dtype=dtype, offsets=offsets, stored=pages[0].stored)
    _check_claims(pages, path)
    directories = np.array([page.directory for page in pages], np.int64)
    return PagedSource(**common, shape=shape, dtype=dtype, directories=directories)


def _check_first(page: Page, path: Path) -> None:
    if len(page.shape) > 2:
        raise SourceError(
            "the pixels have several values each, as in a colour image",
            str(path),
            "one intensity a pixel",
            f"{' x '.join(map(str, page.shape[2:]))} values a pixel",
            "Save the movie as greyscale, from the data and not from the screen",
        )
    checked_dtype(page.stored, str(path))


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
        if page.shape != first.shape or page.stored != first.stored:
            raise SourceError(
                f"page {number} (counted from 0) differs from the first page",
                str(path),
                _words(first),
                _words(page),
                "Take that page out, or export the frames alone",
            )


def _words(page: Page) -> str:
    return f"{' x '.join(map(str, page.shape))} {page.stored.newbyteorder('=')}"


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
