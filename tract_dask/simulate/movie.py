"""Write a drifting low-dose movie of a ceria surface, and return the truth about it."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import tifffile
import xarray as xr

from ..errors import DestinationError, SettingsError
from ..kernels.rendering import PoissonTable, draw_counts, poisson_table
from ..store import disk
from ..store.schema import AXES, texts
from .scene import moving_scene

Image: TypeAlias = np.ndarray[Any, np.dtype[np.float32]]

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
    check_movie(n_frames, pixel_size_pm, frame_time_s, dose, contrast, drift_px, jump_pm)
    _check("shortest side of the field in pm", min(shape) * pixel_size_pm, _SMALLEST_FIELD_PM, 1e6)
    rng = np.random.default_rng(seed)
    drift = random_drift(n_frames, drift_px, rng)
    vacuum = vacuum_counts(dose, pixel_size_pm)
    scene = moving_scene(shape, pixel_size_pm, vacuum, contrast, drift, jump_pm, rng)
    truth = movie_truth(shape, drift, scene.x, scene.y, scene.atoms, scene.surface.kind, scene.role).assign_attrs(
        pixel_size_pm=pixel_size_pm,
        frame_time_s=frame_time_s,
        shape=list(shape),
        dose=dose,
        contrast=contrast,
        vacuum_counts=vacuum,
        seed=seed,
    )
    write_movie(path, truth, scene.expected_counts, scene.limits)
    return truth


def check_movie(
    n_frames: int,
    pixel_size_pm: float,
    frame_time_s: float,
    dose: float,
    contrast: float,
    drift_px: float,
    jump_pm: float,
) -> None:
    """Check the numbers of a movie that is to be simulated; raises SettingsError."""
    _check("n_frames", n_frames, 1, 10**9)
    _check("pixel_size_pm", pixel_size_pm, 0.1, 100.0)
    _check("frame_time_s", frame_time_s, 1e-12, 1e6)
    _check("contrast", contrast, -0.2, 2.0)
    _check("drift_px", drift_px, 0.0, 100.0)
    _check("jump_pm", jump_pm, 0.0, 100.0)
    counts = vacuum_counts(dose, pixel_size_pm)
    _check("dose, as counts of a pixel of vacuum", counts, 0.0, 10_000.0 / (1 + abs(contrast)))


def vacuum_counts(dose: float, pixel_size_pm: float) -> float:
    """Return the expected counts of a pixel of vacuum at a dose in electrons for one square angstrom and frame."""
    return dose * (pixel_size_pm / 100.0) ** 2


def random_drift(n_frames: int, drift_px: float, rng: np.random.Generator) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Return a random walk (frame, axis) in px that begins at 0, with steps of standard deviation ``drift_px``."""
    drift = np.zeros((n_frames, 2))
    drift[1:] = np.cumsum(rng.normal(0.0, drift_px, (n_frames - 1, 2)), axis=0)
    return drift


def write_movie(
    path: str | Path, truth: xr.Dataset, expected_counts: Callable[[int], Image], limits: tuple[float, float]
) -> None:
    """Write Poisson counts as an ImageJ TIFF.

    Parameters
    ----------
    path
        As :func:`simulate_movie`, which raises the same.
    truth
        Its attributes ``shape``, ``pixel_size_pm``, ``frame_time_s`` and ``seed`` are used, and its number of frames.
    expected_counts
        The noise-free image of a frame, called from several threads.
    limits
        Bounds of all expected counts.
    """
    n_frames, attributes = truth.sizes["frame"], truth.attrs
    draw = partial(_draw_frame, expected_counts, poisson_table(*limits), attributes["seed"])
    shape = (n_frames, *attributes["shape"])
    _write_tiff(Path(path), _ahead(draw, n_frames), shape, attributes["pixel_size_pm"], attributes["frame_time_s"])


def movie_truth(
    shape: tuple[int, int],
    drift: np.ndarray[Any, np.dtype[np.float64]],
    x: np.ndarray[Any, Any],
    y: np.ndarray[Any, Any],
    atoms: np.ndarray[Any, Any],
    kind: np.ndarray[Any, Any],
    role: np.ndarray[Any, Any],
) -> xr.Dataset:
    """Return the truth as :func:`simulate_movie` does: of columns (frame, column) those inside frame 0."""
    rows, columns = shape
    inside = (np.abs(x[0] - (columns - 1) / 2) < columns / 2) & (np.abs(y[0] - (rows - 1) / 2) < rows / 2)
    per_frame = ("frame", "column_id")
    return xr.Dataset(
        {
            "x": (per_frame, x[:, inside], {"units": "px"}),
            "y": (per_frame, y[:, inside], {"units": "px"}),
            "atoms": (per_frame, atoms[:, inside]),
            "drift": (("frame", "axis"), drift, {"units": "px"}),
            "kind": ("column_id", texts(kind[inside])),
            "role": ("column_id", texts(role[inside])),
        },
        coords={
            "frame": np.arange(len(drift)),
            "column_id": np.arange(1, int(inside.sum()) + 1),
            "axis": texts(AXES),
        },
    )


def _draw_frame(
    expected_counts: Callable[[int], Image], table: PoissonTable, seed: int, frame: int
) -> np.ndarray[Any, Any]:
    key = np.random.SeedSequence([seed, frame]).generate_state(1, np.uint64)[0]
    counts: np.ndarray[Any, Any] = draw_counts(expected_counts(frame), key, *table)
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
    aside = disk.aside(path)
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


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        raise SettingsError("a value is out of range", f"simulate_movie: {name}", f"{low:g} to {high:g}", f"{value:g}")
