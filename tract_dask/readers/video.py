"""Grey videos (AVI, MP4, MOV), decoded by PyAV, which is an optional package."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError, SourceError
from ..settings.run import SourceSettings
from .checks import Frames, Permit, checked_claim, checked_file, checked_shape
from .source import Source, SourceMetadata
from .times import timed

SUFFIXES = (".avi", ".mp4", ".mov")

_LOSSLESS = ("rawvideo", "ffv1", "huffyuv", "ffvhuff", "utvideo", "png", "v210", "zlib", "qtrle")
"""Codecs whose pixels are those that the camera gave."""

_DEEP = ("gray16le", "gray16be")

_COLOUR = 3
"""Red, green and blue of a grey picture differ by no more: what rounding in other spaces of colour leaves."""

_EMPTY = -(2**63)

_TRIED = 100
"""From so many packets, at the beginning, the first whole frame is looked for."""


@dataclass(frozen=True, kw_only=True, eq=False)
class VideoSource(Source):
    """Frames of a video, decoded from the key frame before them.

    Attributes
    ----------
    stamps
        (frames,) presentation times in units of the stream, ascending.
    keys
        Those of the frames from which decoding can begin.
    pixels
        Name of the pixel format that frames are converted to.
    codec
        Name of the codec.
    """

    stamps: NDArray[np.int64]
    keys: NDArray[np.int64]
    pixels: str
    codec: str

    def _read(self, start: int, stop: int) -> Frames:
        frames = np.empty((stop - start, *self.shape[1:]), self.dtype)
        found = np.zeros(stop - start, bool)
        for number, frame in self._decoded(start, stop):
            frames[number - start] = frame.to_ndarray(format=self.pixels)
            found[number - start] = True
        if not found.all():
            raise SourceError(
                f"frame {start + int(np.argmin(found))} of the video cannot be decoded",
                self.path,
                remedy="Make the copy or the export again",
            )
        return frames

    def _decoded(self, start: int, stop: int) -> Iterator[tuple[int, Any]]:
        """Yield the frames from ``start`` to ``stop`` (not included) with their numbers."""
        av = _package(self.path)
        checked_file(self.files[0])
        with _listening(av) as said, av.open(str(self.files[0]), metadata_errors="ignore") as container:
            stream = container.streams.video[0]
            if self.codec in _LOSSLESS:
                stream.codec_context.thread_count = 1  # what the decoder says of a frame is then said before it comes
            key = self.keys[max(0, int(np.searchsorted(self.keys, self.stamps[start], side="right")) - 1)]
            container.seek(int(key), stream=stream, backward=True)
            said.clear()  # the first frame was decoded on opening
            for frame in container.decode(stream):
                number = int(np.searchsorted(self.stamps, frame.pts if frame.pts is not None else _EMPTY))
                if number >= stop or number >= len(self.stamps):
                    return
                self._check_whole(
                    number, [text for level, who, text in said if level <= av.logging.ERROR and who == self.codec]
                )
                if number >= start and self.stamps[number] == frame.pts and not frame.is_corrupt:
                    yield number, frame
                if number == stop - 1:  # the next one may be damaged
                    return

    def _check_whole(self, number: int, said: list[str]) -> None:
        """Refuse a frame that the decoder called damaged: in place of its pixels it gives those of another frame."""
        if said and self.codec in _LOSSLESS:
            raise SourceError(
                f"frame {number} of the video, or one that it is computed from, is damaged",
                self.path,
                got=said[0].strip(),
                remedy="Make the copy or the export again",
            )


def open_video(path: Path, inner: str, settings: SourceSettings, permit: Permit | None) -> VideoSource:
    """Open the video of a file whose frames are grey.

    Raises
    ------
    InputError
        Where PyAV is not installed.
    SourceError
        Where there is no video in it, it cannot be decoded, or it has colours.
    """
    av = _package(str(path))
    size = path.stat().st_size
    with _listening(av), av.open(str(path), metadata_errors="ignore") as container:
        if not container.streams.video:
            raise SourceError("there is no video in this file", str(path), remedy="Name the movie's file")
        stream = container.streams.video[0]
        shape = (stream.codec_context.height, stream.codec_context.width)
        checked_claim(shape[0] * shape[1], size, str(path))
        packets = sorted((packet.pts, bool(packet.is_keyframe)) for packet in container.demux(stream) if packet.size)
        stamps = np.array([pts for pts, _ in packets if pts is not None], np.int64)
        codec, kind, base = stream.codec_context.name, stream.codec_context.pix_fmt or "", float(stream.time_base or 0)
        container.seek(0, stream=stream)
        first = _first_whole(container, stream, av.FFmpegError)
        if first is None or len(stamps) < len(packets) or len(np.unique(stamps)) < len(stamps):
            raise SourceError(
                "the frames of the video cannot be told apart",
                str(path),
                "a time for each frame",
                f"{len(packets)} frames with {len(np.unique(stamps))} times",
                "Export the movie as TIFF or MRC",
            )
        _check_grey(first, path)
        others = [f"{other.type} {other.index}" for other in container.streams if other is not stream]
        shape = (first.height, first.width)
    deep = kind in _DEEP
    known = _noted(timed(stamps * base, path.name), path.name, codec)
    beside = f"{path.name}: its first video is read; the file also holds {', '.join(others[:9])}"
    return VideoSource(
        path=str(path),
        files=(path,),
        format=f"video ({codec})",
        shape=checked_shape((len(stamps), *shape), str(path)),
        dtype=np.dtype("u2" if deep else "u1"),
        metadata=replace(known, notes=(*known.notes, *((beside,) if others else ()))),
        stamps=stamps,
        keys=np.array([pts for pts, is_key in packets if is_key] or [stamps[0]], np.int64),
        pixels="gray16le" if deep else "gray",
        codec=codec,
    )


def _first_whole(container: Any, stream: Any, failure: type[Exception]) -> Any:
    """Return the first frame that can be decoded, for a damaged one does not hide those behind it; None without frames.

    Raises
    ------
    failure
        Where none of the first ones can be decoded.
    """
    failed: Exception | None = None
    for packet in islice(container.demux(stream), _TRIED):
        try:
            frames = packet.decode()
        except failure as error:
            failed = failed or error
            continue
        if frames:
            return frames[0]
    if failed is not None:
        raise failed
    return None


def _listening(av: Any) -> AbstractContextManager[list[tuple[int, str, str]]]:
    """Return a context with what FFmpeg says in this thread, which is all that some decoders do about damage.

    The level is set for the process and stays: other threads may be reading.
    """
    level = av.logging.get_level()
    if level is None or level < av.logging.ERROR:
        av.logging.set_level(av.logging.ERROR)
    av.logging.set_skip_repeated(False)
    listening: AbstractContextManager[list[tuple[int, str, str]]] = av.logging.Capture()
    return listening


def _package(where: str) -> Any:
    """Return PyAV.

    Raises
    ------
    InputError
        Where it is not installed.
    """
    try:
        import av
    except ImportError as error:
        raise InputError(
            "videos are read by PyAV, which is not installed",
            where,
            remedy='Say: pip install "tract_dask[video]"; or export the movie as TIFF or MRC',
        ) from error
    return av


def _check_grey(frame: Any, path: Path) -> None:
    """Refuse a video with colours."""
    colours = frame.to_ndarray(format="rgb24").astype(np.int16)
    if int(np.ptp(colours, axis=2).max()) > _COLOUR:
        raise SourceError(
            "the pixels are RGB colours",
            str(path),
            "a grey video",
            "colours in its first frame",
            "Export the grey frames as TIFF or MRC, without overlays",
        )


def _noted(known: SourceMetadata, name: str, codec: str) -> SourceMetadata:
    """Return what is known of a video; a note where its compression has changed the pixels."""
    if codec in _LOSSLESS:
        return known
    note = (
        f"{name} is compressed by {codec}, which changes the pixels: noise, errors and intensities that are computed"
        " from them are not to be trusted; take the camera's own file where there is one"
    )
    return replace(known, notes=(*known.notes, note))
