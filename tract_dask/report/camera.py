"""What a report says of the camera: what was measured, and where that is not what was said; and of faint columns."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import NDArray

from ..kernels.gaussian.model import blurred
from ..kernels.gaussian.parameters import AMPLITUDE, BACKGROUND, SIGMA_A, SIGMA_B, X, Y
from ..kernels.patterns import fine
from ..kernels.rendering import add_columns
from ..kernels.windows import blur_variance
from ..store.camera import Camera

OFF = 0.1
"""A gain, or an offset as a share of the usual level above it, that is off by more than this is worth a warning."""
PATTERN = 0.02
"""A fixed pattern with a larger standard deviation, as a share of the level, is worth a warning."""
FAINT, FAINT_ERRORS = 0.03, 0.05
"""Square of the relative error of a single frame's intensity, by which intensities are too large, from which a warning
is worth it where it is more than :data:`OFF_BY` stated errors of a column's mean; and by which errors of places are too
small."""
OFF_BY = 2.0
_MOST = 0.5
_SHARP_PX, _NARROWEST_PX, _DOUBT = 1.3, 0.3, 1.5
"""Columns of less than this sigma are as fine as a pattern, and are drawn with no less than that; what they have of it
is known to this factor."""
FREE_SHARES = 0.2, 0.5
"""Between these shares of its square intensities with free shapes are too large, where they scatter by less than 80 %:
of 1,500 fits of Gaussians each, of sigmas of 3 and 6 px, at three doses."""
_SURE = 5.0
"""Standard errors by which it must be off as well; columns that move by themselves leave more than one."""
_TOLD = 0.2
"""An offset that is told from read noise, and is off by this share of the level above it, is worth a warning, too."""
_READ_SHARE = 0.5
"""An offset that would leave more than this share of the noise to the read noise is doubted."""


def pattern_words(camera: Camera, of_columns: float = 0.0) -> dict[str, Any] | None:
    """Return what there is to say of a fixed pattern: title, text and remedy; None where there is none to speak of.

    ``of_columns``: what columns as fine as a pattern have of its variance, see :func:`fine_columns`.
    """
    if camera.fixed_pattern <= PATTERN or (camera.pattern or 0.0) - _DOUBT * of_columns <= PATTERN**2:
        return None
    text = (
        f"The pixels differ in sensitivity by {camera.fixed_pattern:.1%} (standard deviation). Columns move over this "
        "pattern, and their places and intensities scatter by more than the errors say."
    )
    remedy = "Run again with --gain-reference (and --dark) of this camera."
    return {"title": "The detector has a fixed pattern", "text": text, "remedy": remedy}


def fine_columns(tracks: xr.Dataset, drift: NDArray[np.float64], shape: tuple[int, ...]) -> float:
    """Return the variance, as a share of the level squared, that columns have where a fixed pattern is looked for.

    It is 0 for columns of more than 1.3 px, which have next to none, and where most frames lie apart by their ``drift``
    (frame, axis): a shift by one pixel turns the sign of what is so fine. ``shape`` is that of the summed image (y, x).
    """
    fit = tracks["fit_ref"].to_numpy().astype(np.float64)
    own = blurred(fit[np.isfinite(fit).all(axis=1)], -blur_variance(float(tracks.attrs["reference_blur_px"])))
    sigma = np.sqrt(np.maximum(own[:, SIGMA_A] * own[:, SIGMA_B], _NARROWEST_PX**2))
    if not len(own) or np.median(sigma) > _SHARP_PX or _share_alike(drift) < _MOST:
        return 0.0
    image = np.full(shape, np.median(own[:, BACKGROUND]))
    add_columns(image, own[:, X], own[:, Y], own[:, AMPLITUDE], sigma)
    level = float(np.square(image).mean())
    return float(np.square(fine(image)).mean()) / level if level > 0 else 0.0


def _share_alike(drift: NDArray[np.float64]) -> float:
    """Return the share of pairs of frames that lie alike, to a pixel."""
    count = np.unique(np.rint(drift), axis=0, return_counts=True)[1]
    return float((count**2).sum()) / max(1, len(drift)) ** 2


def faint_words(faint: NDArray[np.float64], accepted: NDArray[np.int64]) -> dict[str, Any] | None:
    """Return what there is to say of intensities that noise makes too large; None where that is little.

    A fit looks for its place, and finds that at which noise adds to the column: in units of its error s the amplitude A
    is higher by s / A in the mean, so by the share (s / A)^2, of which ``faint`` (column) is the estimate. The mean of
    ``accepted`` (column) n fits states a relative error of s / A / sqrt(n), and is off by sqrt(n) s / A such errors.
    """
    known = np.isfinite(faint)
    share = float(np.median(faint[known])) if known.any() else 0.0
    errors = float(np.median(np.sqrt(faint[known] * accepted[known]))) if known.any() else 0.0
    if share <= FAINT or (errors <= OFF_BY and share <= FAINT_ERRORS):
        return None
    text = (
        f"The intensity of a column in a single frame has an error of {np.sqrt(share):.0%} (median). Fits end where "
        f"noise adds to a column: intensities and amplitudes are too large by about {share:.0%} in the mean, which is "
        f"{errors:.1f} stated errors of a column's mean, and the errors of places are too small by about as much."
    )
    remedy = "Sum frames (rebin_frames). Columns that are equally bright can be compared with each other as well."
    return {"title": "Columns are faint in single frames", "text": text, "remedy": remedy}


def free_words(scatter: NDArray[np.float64], accepted: NDArray[np.int64]) -> dict[str, Any] | None:
    """Return what there is to say of intensities whose widths are fitted as well; None where that is little.

    Width and background take each other's part, and a column can be far too wide, but hardly too narrow: most values
    are a little too small, and a few much too large. ``scatter`` (column) is that of single frames, relative.
    """
    known = np.isfinite(scatter)
    share = float(np.median(scatter[known] ** 2)) if known.any() else 0.0
    number = float(np.median(accepted[known])) if known.any() else 0.0
    low, high = (part * share for part in FREE_SHARES)
    if high <= FAINT or (low * np.sqrt(number) <= OFF_BY * np.sqrt(share) and high <= FAINT_ERRORS):
        return None
    text = (
        f"Widths are fitted in every frame, and with them the intensity of a column scatters by {np.sqrt(share):.0%} "
        f"(median). A few values are far too large: means are too large by about {low:.0%} to {high:.0%}."
    )
    remedy = "Run again with --shape fixed, or sum frames (rebin_frames). Medians are less off than means."
    return {"title": "Intensities with free widths are too large", "text": text, "remedy": remedy}


def camera_findings(
    camera: Camera, gain: float, offset: float, level: float, *, dark: bool = False
) -> Iterator[dict[str, Any]]:
    """Yield what there is to say of gain and offset: title, text, remedy and whether it is serious.

    Parameters
    ----------
    gain, offset
        As the movie has them: counts for a detector unit, and detector units without electrons.
    level
        The usual pixel, detector units.
    dark
        Whether a dark image was subtracted.
    """
    if camera.per_electron is None or camera.zero is None:
        text = f"Gain and offset could not be compared with the noise: {camera.reason}."
        yield {"title": "The camera was not measured", "text": text, "serious": False}
        return
    off = abs(gain * camera.per_electron - 1)
    if off > OFF and off > _SURE * (camera.per_electron_stderr or 0) / camera.per_electron:
        text = (
            f"The noise is that of {camera.per_electron:.3g} detector units an electron, a gain of "
            f"{1 / camera.per_electron:.3g}; {gain:.3g} was said. Equation 5, doses and numbers of electrons are wrong "
            "by that factor; positions and errors of the fits are not."
        )
        remedy = "Run the same command again with --gain auto."
        yield {"title": "The gain is not what was said", "text": text, "remedy": remedy}
    above = level - camera.zero
    below, share = camera.zero - offset, (offset - camera.zero) / above if above > 0 else 0.0
    known = camera.offset if camera.offset is not None else camera.zero
    sure = _SURE * (camera.zero_stderr or 0)
    told_apart = camera.offset is not None and abs(camera.offset - offset) > max(_TOLD * above, sure)
    if above > 0 and ((below > OFF * above and below > sure) or (share > _READ_SHARE and -below > sure) or told_apart):
        text = (
            f"The noise tells of an offset of {known:.4g} detector units, where the usual pixel has {level:.4g}; "
            f"{offset:.4g} was said. Backgrounds and intensities in units of vacuum are wrong by the difference."
        )
        remedy = "Run the same command again with --offset auto, or with the number that the camera's maker gives."
        if dark and known < offset:
            text += " The frames were dark-corrected before, as it seems, and the dark image was subtracted again."
            remedy = "Run again without --dark; or with --offset auto, where the dark image is right."
        yield {"title": "The offset is not what was said", "text": text, "remedy": remedy}
