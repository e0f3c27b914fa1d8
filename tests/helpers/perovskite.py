"""Tracks of a perovskite whose strain and off-centring are known."""

import numpy as np
import xarray as xr

from tract_dask.kernels.gaussian.parameters import PARAMETERS
from tract_dask.store.results import FITTED

CELL_PM, PIXEL_PM, FRAMES, ERROR_PM = 390.5, 8.0, 25, 6.0
OFF_CENTRE = np.array([9.0, -14.0])
"""Of B, pm, x and y."""
SIDE = 9


def places_of(strained):
    """Perovskite cells, turned by 4 degrees, (n, 2) pm and kinds; ``strained`` moves them."""
    turn = np.deg2rad(4.0)
    matrix = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    i, j = np.mgrid[:SIDE, :SIDE].reshape(2, -1)
    first = CELL_PM * np.stack([i, j], axis=1)
    second = first[(i < SIDE - 1) & (j < SIDE - 1)] + CELL_PM / 2
    at = np.concatenate([first, second]) @ matrix + 500.0
    kinds = np.array(["A"] * len(first) + ["B"] * len(second))
    at = strained(at)
    at[kinds == "B"] += OFF_CENTRE
    return at, kinds


def tracks_of(strained=lambda at: at, seed=0):
    """Tracks of these places with errors that are stated as they are; fits of one column were never accepted."""
    at, kinds = places_of(strained)
    rng = np.random.default_rng(seed)
    fit = np.full((FRAMES, len(at), len(PARAMETERS)), np.nan)
    x, y = PARAMETERS.index("x"), PARAMETERS.index("y")
    fit[..., [x, y]] = (at + rng.normal(0, ERROR_PM, (FRAMES, *at.shape))) / PIXEL_PM
    stderr = np.full_like(fit, ERROR_PM / PIXEL_PM)
    status = np.zeros(fit.shape[:2], np.uint16)
    status[:, 40] = 1
    dims = "frame", "column_id", "parameter"
    return xr.Dataset(
        {
            "fit": (dims, fit),
            "stderr": (dims, stderr),
            "status": (dims[:2], status),
            **{name: (dims[:2], np.ones(status.shape)) for name in set(FITTED) - {"fit", "stderr"}},
            "kind": ("column_id", kinds),
            "x_ref": ("column_id", at[:, 0] / PIXEL_PM),
            "y_ref": ("column_id", at[:, 1] / PIXEL_PM),
        },
        {"frame": np.arange(FRAMES), "column_id": np.arange(1, len(at) + 1), "parameter": list(PARAMETERS)},
        {"pixel_size_pm": PIXEL_PM},
    )


def field(at):
    """A strain along x that grows by 4 % over the field, 1 % along y, a shear of 0.6 %, a rotation of 3 mrad."""
    x, y = (at - 2000.0).T
    grow = 0.04 / 3500
    return at + np.stack([grow * x**2 / 2 + 0.003 * y, 0.01 * y + 0.009 * x], axis=1)
