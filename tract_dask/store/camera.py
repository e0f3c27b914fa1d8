"""What was measured of a camera, as the summed image and the tracks carry it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

ATTRIBUTE = "camera"
"""Name of the attribute."""

_SURE = 5.0
"""Standard errors of a pattern that is sure to be there."""


@dataclass(frozen=True)
class Camera:
    """The noise of a camera in detector units, as :func:`tract_dask.stages.noise.measure_camera` finds it.

    Attributes
    ----------
    per_electron, per_electron_stderr
        Detector units for an electron; None where it could not be measured.
    zero, zero_stderr
        Level of a pixel at which its noise would vanish: the offset, less the read noise's variance / per_electron.
    offset
        Level without electrons; None where it cannot be told from read noise.
    read_noise
        Its standard deviation; None as well.
    noise_per_count
        Variance of a pixel for a detector unit above ``zero``: ``per_electron``, or less where pixels share electrons.
    correlation
        Of the noise of pixels at lags (y, x), an odd number of each, the middle is 1; None where not measured.
    pattern, pattern_stderr
        Variance of a fixed pattern of the pixels as a share of their level squared; None where not measured.
    frames
        Of the camera in a frame of the movie that was measured.
    reason
        Why something could not be measured, in words.
    """

    per_electron: float | None = None
    per_electron_stderr: float | None = None
    zero: float | None = None
    zero_stderr: float | None = None
    offset: float | None = None
    read_noise: float | None = None
    noise_per_count: float | None = None
    correlation: tuple[tuple[float, ...], ...] | None = None
    pattern: float | None = None
    pattern_stderr: float | None = None
    frames: int = 1
    reason: str = ""

    @classmethod
    def of(cls, attributes: Mapping[str, Any] | None) -> Camera:
        """Return what the attributes of a Dataset or a store say; a camera of which nothing is known otherwise."""
        text = (attributes or {}).get(ATTRIBUTE)
        said = json.loads(text) if isinstance(text, str) else None
        if not isinstance(said, dict):
            return NOT_MEASURED
        known = {name: said[name] for name in cls.__dataclass_fields__ if name in said}
        if known.get("correlation") is not None:
            known["correlation"] = tuple(tuple(map(float, row)) for row in known["correlation"])
        return cls(**known)

    def to_attribute(self) -> dict[str, str]:
        """Return the attribute that :meth:`of` reads: JSON, without what is not known."""
        return {ATTRIBUTE: json.dumps({name: value for name, value in asdict(self).items() if value is not None})}

    def of_sums(self, frames: int) -> Camera:
        """Return the camera of sums of so many frames."""
        if frames == 1:
            return self
        levels = {name: getattr(self, name) for name in ("zero", "zero_stderr", "offset")}
        scaled = {name: None if value is None else frames * value for name, value in levels.items()}
        noise = None if self.read_noise is None else self.read_noise * frames**0.5
        of_sum: dict[str, Any] = scaled | {"read_noise": noise, "frames": frames * self.frames}
        return replace(self, **of_sum)

    def in_words(self) -> dict[str, Any]:
        """Return what was measured by names with units, and why the rest was not."""
        found = {
            "detector units an electron": self.per_electron,
            "level without noise": self.zero,
            "offset, measured": self.offset,
            "read noise, rms": self.read_noise,
            "fixed pattern of the pixels": self.fixed_pattern or None,
            "pixels that share noise": None if self.correlation is None else float(self.shared.sum()),
        }
        known: dict[str, Any] = {name: float(f"{value:.4g}") for name, value in found.items() if value is not None}
        return known | ({"camera": self.reason} if self.reason else {})

    @property
    def fixed_pattern(self) -> float:
        """Standard deviation of the pixels' fixed pattern as a share of their level; 0 where there is none for sure."""
        if self.pattern is None or self.pattern_stderr is None or self.pattern < _SURE * self.pattern_stderr:
            return 0.0
        return float(self.pattern**0.5)

    @property
    def shared(self) -> NDArray[np.float64]:
        """The autocorrelation of the noise as an array; ``[[1.0]]`` where none was found, or none measured."""
        return np.array(self.correlation or ((1.0,),), np.float64)


NOT_MEASURED = Camera(reason="the camera was not measured")
