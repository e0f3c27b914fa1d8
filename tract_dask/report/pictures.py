"""Pictures for a page: figures and images as data that stand in the page itself."""

from __future__ import annotations

import io
from base64 import b64encode

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from matplotlib.image import imsave
from numpy.typing import NDArray

_QUALITY = 88


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


def _url(data: bytes, kind: str) -> str:
    return f"data:image/{kind};base64,{b64encode(data).decode('ascii')}"
