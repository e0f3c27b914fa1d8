"""Tracks of columns whose spreads and jump are known, for the tests of figures."""

from __future__ import annotations

import numpy as np
import xarray as xr
from matplotlib.figure import Figure

from tract_dask.store import schema
from tract_dask.store.columns import column_dataset

PIXEL_PM = 4.0
WINDOW, BLUR = 21, 2.0
SHAPE = (120, 140)
PLACES = np.array([[30.0, 30.0], [70.0, 30.0], [110.0, 30.0], [30.0, 80.0], [70.0, 80.0], [110.0, 80.0]])
N_FRAMES = 30
JUMP_FRAME, JUMP_PX = 15, np.array([6.0, -3.0])


def parameters() -> np.ndarray:
    fit = np.zeros((len(PLACES), 7))
    fit[:] = 50.0, 0, 0, 6.0, 4.0, 0.5, 20.0
    fit[:, 1:3] = PLACES
    return fit


def make_tracks(n_frames: int = N_FRAMES) -> xr.Dataset:
    """Columns whose spread is that of their number, in units of 0.1 px; the second one jumps."""
    rng = np.random.default_rng(3)
    n = len(PLACES)
    fit = np.broadcast_to(parameters(), (n_frames, n, 7)).copy()
    fit[..., 1:3] += rng.normal(size=(n_frames, n, 2)) * 0.1 * np.arange(1, n + 1)[:, None]
    fit[JUMP_FRAME:, 1, 1:3] += JUMP_PX
    stderr = np.broadcast_to(0.1 * np.arange(1.0, n + 1)[:, None], (n_frames, n, 7)).copy()
    intensity = 1000 + rng.normal(size=(n_frames, n)) * 10 * np.arange(1, n + 1)
    status = np.zeros((n_frames, n), np.uint16)
    status[4, 0] = schema.Status.BELOW_NOISE
    columns = column_dataset(PLACES, "Ce", fit=parameters())
    values = {
        "fit": fit,
        "stderr": stderr,
        "centroid": 1.5 * (fit[..., [2, 1]] - PLACES[:, ::-1]) + PLACES[:, ::-1],
        "intensity": intensity,
        "intensity_error": np.full_like(intensity, 20.0),
        "intensity_stderr": np.full_like(intensity, 25.0),
        "status": status,
        "drift": rng.normal(size=(n_frames, 2)),
        "noise": np.ones((n_frames, n)),
        "time": 0.1 * np.arange(n_frames),
        "r_squared": np.full((n_frames, n), 0.9),
        "p_value": np.full((n_frames, n), 0.5, np.float32),
    }
    tracks = columns.assign_coords(schema.coordinates(n_frames)).assign(
        {name: (schema.RESULTS[name].dims, value, schema.RESULTS[name].attributes) for name, value in values.items()}
    )
    return tracks.assign_attrs(
        pixel_size_pm=PIXEL_PM,
        frame_time_s=0.1,
        dose=500.0,
        window_px=WINDOW,
        window_blur_px=BLUR,
        reference_blur_px=BLUR,
        shape="fixed",
        estimator="lsq",
        intensity_scale="paper",
    )


def every_axes(figure: Figure) -> list:
    return list(figure.findobj(lambda artist: hasattr(artist, "get_xlim")))
