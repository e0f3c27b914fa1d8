"""Raw frames of Merlin detectors: 64-bit words in which the last pixel comes first, and chips side by side."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import SourceError
from ..blocks import BlockSource
from ..checks import Frames

_PIXELS_IN_WORD = {1: 64, 6: 8, 12: 4, 24: 4}
"""By the depth of the counter in bits; 24 bits are two frames of 12, of which the first has the upper half."""

_DTYPES = {1: "u1", 6: "u1", 12: "u2", 24: "u4"}


@dataclass(frozen=True)
class RawLayout:
    """How a frame is stored.

    Attributes
    ----------
    depth
        Bits of a counter: 1, 6, 12 or 24.
    n_y, n_x
        Rows and columns as stored, where the chips stand side by side.
    quad
        Whether these are four chips that form a square: from left to right the lower right, the lower left (both turned
        by 180 degrees), the upper right and the upper left one.
    """

    depth: int
    n_y: int
    n_x: int
    quad: bool

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the image."""
        return (2 * self.n_y, self.n_x // 2) if self.quad else (self.n_y, self.n_x)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the image's pixels."""
        return np.dtype(_DTYPES[self.depth])

    @property
    def n_words(self) -> int:
        """Words of 64 bits of a frame."""
        return self.n_y * self.n_x // _PIXELS_IN_WORD[self.depth] * (2 if self.depth == 24 else 1)

    def check(self, where: str) -> None:
        """Check that the depth is known and that chips are whole words wide.

        Raises
        ------
        SourceError
            Where they are not.
        """
        width = self.n_x // 4 if self.quad else self.n_x
        if self.depth in _PIXELS_IN_WORD and width > 0 and width % _PIXELS_IN_WORD[self.depth] == 0:
            return
        raise SourceError(
            "the header's raw frames are impossible",
            where,
            f"a depth of {', '.join(map(str, _PIXELS_IN_WORD))} bits, and chips that are whole 64-bit words wide",
            f"{self.depth} bits, chips {width} pixels wide",
            "Save the frames processed, not raw",
        )


def decoded(words: NDArray[np.uint64], layout: RawLayout) -> NDArray[Any]:
    """Return the image (y, x) of a raw frame, from its big-endian words (n_words,)."""
    stored = words.astype("<u8").view(np.uint8)  # now the first pixel is the lowest part of a word
    if layout.depth == 1:
        pixels: NDArray[Any] = np.unpackbits(stored, bitorder="little")
    elif layout.depth == 6:
        pixels = stored
    else:
        pixels = stored.view("<u2")
    if layout.depth == 24:
        high, low = pixels.reshape(2, -1)
        pixels = (high.astype(np.uint32) << 12) + low
    frame = pixels.reshape(layout.n_y, layout.n_x)
    return _square(frame) if layout.quad else frame


def _square(frame: NDArray[Any]) -> NDArray[Any]:
    """Return the square of four chips (2n, 2m) that stand side by side (n, 4m)."""
    lower_right, lower_left, upper_right, upper_left = np.split(frame, 4, axis=1)
    return np.block([[upper_left, upper_right], [lower_left[::-1, ::-1], lower_right[::-1, ::-1]]])


@dataclass(frozen=True, kw_only=True, eq=False)
class RawSource(BlockSource):
    """Raw frames at known places in one file.

    Attributes
    ----------
    layout
        How they are stored.
    """

    layout: RawLayout

    def _fill(self, start: int, frames: Frames) -> None:
        words = np.empty((1, self.layout.n_words), self.stored)
        for k in range(len(frames)):
            self._fill_as_stored(start + k, words)
            frames[k] = decoded(words[0], self.layout)
