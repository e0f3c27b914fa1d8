"""Pictures for a page: figures and images as data that stand in the page itself."""

from __future__ import annotations

import io
from base64 import b64encode

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.image import imsave
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter

_QUALITY = 88
_MASK_POINTS = 480

MASK_COLOURS = {"hot": "tab:red", "dead": "black", "lines": "tab:blue", "given": "tab:purple"}
"""By kind, in the order of :data:`tract_dask.store.pixels.KINDS`."""


def figure_data(figure: Figure, dpi: float) -> str:
    """Return a figure as a data URL (WebP)."""
    file = io.BytesIO()
    figure.savefig(file, format="webp", dpi=dpi, pil_kwargs={"quality": _QUALITY})
    return _url(file.getvalue(), "webp")


def grey_data(levels: NDArray[np.uint8]) -> str:
    """Return grey levels (y, x) as a data URL (WebP)."""
    file = io.BytesIO()
    imsave(file, levels, format="webp", cmap="gray", vmin=0, vmax=255, pil_kwargs={"quality": _QUALITY, "method": 0})
    return _url(file.getvalue(), "webp")


def windows_data(shown: NDArray[np.float64]) -> str:
    """Return the image, the model and the residual of a column side by side as a data URL (PNG).

    Parameters
    ----------
    shown
        (3, window, window), NaN beyond the disc. Image and model have the same greys; the residual is blue where it is
        negative and red where it is positive, full colour at a quarter of the range of the image.
    """
    image, model, residual = shown
    low, high = np.nanmin([image, model]), np.nanmax([image, model])
    span = high - low or 1.0
    grey, signed = mpl.colormaps["gray"], mpl.colormaps["RdBu_r"]
    panels = [grey((image - low) / span), grey((model - low) / span), signed(0.5 + 2 * residual / span)]
    gap = np.zeros((len(image), 2, 4))
    beyond = ~np.isfinite(image)
    for panel in panels:
        panel[beyond] = 0.0
    file = io.BytesIO()
    imsave(file, np.concatenate([panels[0], gap, panels[1], gap, panels[2]], axis=1), format="png")
    return _url(file.getvalue(), "png")


def mask_data(mask: NDArray[np.uint8]) -> str:
    """Return which pixels are masked (y, x), by kind in :data:`MASK_COLOURS`, as a data URL (PNG).

    A point of the picture has the kind with the highest number of its pixels; single ones are drawn 3 points wide.
    """
    step = -(-max(mask.shape) // _MASK_POINTS)
    rows, columns = (-(-side // step) for side in mask.shape)
    whole = np.zeros((rows * step, columns * step), np.uint8)
    whole[: mask.shape[0], : mask.shape[1]] = mask
    shown = maximum_filter(whole.reshape(rows, step, columns, step).max(axis=(1, 3)), 3)
    palette = np.array([mpl.colors.to_rgb(colour) for colour in ("0.9", *MASK_COLOURS.values())])
    file = io.BytesIO()
    imsave(file, palette[shown], format="png")
    return _url(file.getvalue(), "png")


def _url(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{b64encode(data).decode('ascii')}"
