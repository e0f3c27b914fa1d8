"""Write a drifting low-dose movie of a ceria surface, and return the truth about it."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import xarray as xr

from ..errors import DestinationError, SettingsError
from ..kernels.rendering import PoissonTable, draw_counts, poisson_table
from ..schema import AXES, texts
from .scene import Scene, moving_scene

_CLASSIC_TIFF_BYTES = 2**32 - 2**25
_SMALLEST_FIELD_PM = 1200.0


def simulate_movie(
    path: str | Path,
    *,
    n_frames: int = 60,
    shape: tuple[int, int] = (512, 512),
    pixel_size_pm: float = 8.0,
    frame_time_s: float = 0.1,
    dose: float = 500.0,
    contrast: float = 0.5,
    drift_px: float = 0.3,
    jump_pm: float = 15.0,
    seed: int = 0,
) -> xr.Dataset:
    """Write a movie of a CeO2 [110] surface as an ImageJ TIFF (uint16) and return its truth.

    Every frame is the analytic model (a level and one Gaussian a column) at that frame's exact positions, with Poisson
    noise; nothing is interpolated. Frames are made and written one after another, so the movie can be larger than
    memory; above 4 GB the file is a BigTIFF. The same arguments give the same file.

    Parameters
    ----------
    path
        The file to write; what is there is replaced once the new file is whole.
    n_frames, shape
        Frames, and pixels of a frame (y, x).
    pixel_size_pm, frame_time_s
        Written into the file as well.
    dose
        Electrons for one square angstrom and frame; the vacuum has ``dose * (pixel_size_pm / 100)**2`` counts a pixel.
    contrast
        Strength of the image contrast: 1 is that of a perfect microscope, 0.5 is closer to experiment; negative values
        make the columns dark.
    drift_px
        Standard deviation per axis of the field's random step from frame to frame.
    jump_pm
        How far the jumping column jumps.
    seed
        The number that fixes all randomness.

    Returns
    -------
    Dataset
        ``x``, ``y`` (frame, column_id): positions in the frame's own pixels, drift included, also where a column is
        absent; ``atoms`` (frame, column_id), 0 where it is absent; ``drift`` (frame, axis) from frame 0, in px;
        ``kind`` ("Ce" or "O") and ``role`` ("static", "jumping" or "absent") of every column. It holds the columns
        that are inside frame 0, numbered from 1: cerium in reading order, then oxygen.

    Raises
    ------
    SettingsError
        Where a number is out of its range, or the field is smaller than 1.2 nm.
    DestinationError
        Where the file cannot be written.
    """
    _check("n_frames", n_frames, 1, 10**9)
    _check("pixel_size_pm", pixel_size_pm, 0.1, 100.0)
    _check("shortest side of the field in pm", min(shape) * pixel_size_pm, _SMALLEST_FIELD_PM, 1e6)
    _check("frame_time_s", frame_time_s, 1e-12, 1e6)
    _check("contrast", contrast, -0.2, 2.0)
    _check("drift_px", drift_px, 0.0, 100.0)
    _check("jump_pm", jump_pm, 0.0, 100.0)
    vacuum = dose * (pixel_size_pm / 100.0) ** 2
    _check("dose, as counts of a pixel of vacuum", vacuum, 0.0, 10_000.0 / (1 + abs(contrast)))

    rng = np.random.default_rng(seed)
    drift = np.zeros((n_frames, 2))
    drift[1:] = np.cumsum(rng.normal(0.0, drift_px, (n_frames - 1, 2)), axis=0)
    scene = moving_scene(shape, pixel_size_pm, vacuum, contrast, drift, jump_pm, rng)
    draw = partial(_draw_frame, scene, poisson_table(*scene.limits), seed)
    _write_tiff(Path(path), _ahead(draw, n_frames), (n_frames, *shape), pixel_size_pm, frame_time_s)
    return _truth(scene).assign_attrs(
        pixel_size_pm=pixel_size_pm,
        frame_time_s=frame_time_s,
        shape=list(shape),
        dose=dose,
        contrast=contrast,
        vacuum_counts=vacuum,
        seed=seed,
    )


def _draw_frame(scene: Scene, table: PoissonTable, seed: int, frame: int) -> np.ndarray[Any, Any]:
    key = np.random.SeedSequence([seed, frame]).generate_state(1, np.uint64)[0]
    counts: np.ndarray[Any, Any] = draw_counts(scene.expected_counts(frame), key, *table)
    return counts


def _ahead(draw: Callable[[int], np.ndarray[Any, Any]], n_frames: int) -> Iterator[np.ndarray[Any, Any]]:
    """Yield the frames in order, drawn by threads that keep only a few frames ahead."""
    threads = min(4, os.cpu_count() or 1)
    waiting: deque[Future[np.ndarray[Any, Any]]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        for frame in range(n_frames):
            waiting.append(pool.submit(draw, frame))
            if len(waiting) > threads:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def _write_tiff(
    path: Path,
    frames: Iterator[np.ndarray[Any, Any]],
    shape: tuple[int, int, int],
    pixel_size_pm: float,
    frame_time_s: float,
) -> None:
    """Write the frames with ImageJ's description of them, aside first."""
    lines = {
        "ImageJ": "1.11a",
        "images": shape[0],
        "frames": shape[0],
        "hyperstack": "true",
        "mode": "grayscale",
        "loop": "false",
        "unit": "nm",
        "finterval": frame_time_s,
    }
    aside = path.with_name(f".{path.name}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        tifffile.imwrite(
            aside,
            frames,
            shape=shape,
            dtype=np.uint16,
            bigtiff=2 * int(np.prod(shape)) > _CLASSIC_TIFF_BYTES,
            photometric="minisblack",
            resolution=(1000.0 / pixel_size_pm, 1000.0 / pixel_size_pm),
            resolutionunit="NONE",
            description="".join(f"{name}={value}\n" for name, value in lines.items()),
            metadata=None,
        )
        aside.replace(path)
    except OSError as error:
        with suppress(OSError):
            aside.unlink(missing_ok=True)
        raise DestinationError(
            "the movie cannot be written",
            str(path),
            "a folder that you may write to, with space",
            error.strerror or str(error),
            "Choose another place",
        ) from error


def _truth(scene: Scene) -> xr.Dataset:
    rows, columns = scene.shape
    inside = (np.abs(scene.x[0] - (columns - 1) / 2) < columns / 2) & (np.abs(scene.y[0] - (rows - 1) / 2) < rows / 2)
    per_frame = ("frame", "column_id")
    return xr.Dataset(
        {
            "x": (per_frame, scene.x[:, inside], {"units": "px"}),
            "y": (per_frame, scene.y[:, inside], {"units": "px"}),
            "atoms": (per_frame, scene.atoms[:, inside]),
            "drift": (("frame", "axis"), scene.drift, {"units": "px"}),
            "kind": ("column_id", texts(scene.surface.kind[inside])),
            "role": ("column_id", texts(scene.role[inside])),
        },
        coords={
            "frame": np.arange(len(scene.drift)),
            "column_id": np.arange(1, int(inside.sum()) + 1),
            "axis": texts(AXES),
        },
    )


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise SettingsError(
            "a simulated movie cannot be made so", f"simulate_movie: {name}", f"{low:g} to {high:g}", f"{value:g}"
        )
