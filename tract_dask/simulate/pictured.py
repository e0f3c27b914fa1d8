"""Movies of multislice images: one calculation for each arrangement of the atoms, drift by the shift theorem."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ..settings.toml import to_toml
from .movie import Image, check_movie, movie_truth, random_drift, vacuum_counts, write_movie
from .multislice import BORDER_PM, Picture, pictures
from .scene import Scene, moving_scene
from .settings import PRESETS, Microscope
from .structures import Specimen, projected_columns, require_simulators, surface_specimen

_OVERSHOOT = 0.03
"""By how much an image between pixels may exceed the range of its pixels, as a share of that range."""


@dataclass(frozen=True)
class PicturedScene:
    """A scene whose frames are multislice images.

    ``state`` (frame) says which of ``pictures`` a frame shows; ``drift`` is (frame, axis) from frame 0, in px;
    ``vacuum`` is the expected count of an empty pixel.
    """

    pictures: list[Picture]
    state: np.ndarray[Any, np.dtype[np.int64]]
    drift: np.ndarray[Any, np.dtype[np.float64]]
    vacuum: float
    contrast: float

    def expected_counts(self, frame: int) -> Image:
        """Return the noise-free image of a frame."""
        image = self.pictures[self.state[frame]].sample((self.drift[frame, 0], self.drift[frame, 1]))
        counts: Image = np.clip(self.vacuum * (1 + self.contrast * (image - 1)), *self.limits)
        return counts

    @cached_property
    def limits(self) -> tuple[float, float]:
        """Bounds of the expected counts of every frame."""
        edges = 1 + self.contrast * (np.array([picture.range for picture in self.pictures]) - 1)
        room = _OVERSHOOT * float(np.ptp(edges))
        return self.vacuum * max(0.0, float(edges.min()) - room), self.vacuum * (float(edges.max()) + room)


def simulate_multislice_movie(
    path: str | Path,
    specimen: Specimen | None = None,
    microscope: Microscope = PRESETS["paper"],
    *,
    n_frames: int = 60,
    shape: tuple[int, int] = (512, 512),
    pixel_size_pm: float = 4.0,
    frame_time_s: float = 0.1,
    dose: float = 500.0,
    contrast: float = 1.0,
    drift_px: float = 0.3,
    jump_pm: float = 15.0,
    seed: int = 0,
) -> xr.Dataset:
    """Write a movie of multislice images with Poisson noise as an ImageJ TIFF (uint16), and return its truth.

    Without a ``specimen`` it shows the CeO2 step of :func:`tract_dask.simulate_movie`, in which one column jumps and
    one is absent at times; the atoms of a column move, appear and disappear together, and oxygen stays. Any other
    specimen only drifts. Every arrangement of the atoms that occurs is calculated once.

    Parameters
    ----------
    path, n_frames, frame_time_s, dose, drift_px, seed
        As :func:`tract_dask.simulate_movie`.
    specimen
        From :mod:`tract_dask.simulate.structures`; its field of view is the movie's.
    microscope
        Its settings.
    shape, jump_pm
        Pixels of a frame (y, x), and how far the jumping column jumps; only where there is no ``specimen``.
    pixel_size_pm
        Size of a pixel.
    contrast
        By which the image's deviation from vacuum is multiplied: 1 is that of the calculation; experiments show less
        (the Stobbs factor).

    Returns
    -------
    Dataset
        As :func:`tract_dask.simulate_movie`, with the attribute ``microscope`` (TOML).

    Raises
    ------
    SettingsError, DestinationError, InputError
        As :func:`tract_dask.simulate_movie` and :func:`tract_dask.simulate.multislice_image`.
    """
    check_movie(n_frames, pixel_size_pm, frame_time_s, dose, contrast, drift_px, jump_pm)
    require_simulators()
    rng = np.random.default_rng(seed)
    drift = random_drift(n_frames, drift_px, rng)
    vacuum = vacuum_counts(dose, pixel_size_pm)
    if specimen is None:
        scene = moving_scene(shape, pixel_size_pm, vacuum, contrast, drift, jump_pm, rng)
        found, state, columns = _moving_ceria(scene, microscope)
    else:
        found, state = [_picture(specimen, microscope, pixel_size_pm, drift)], np.zeros(n_frames, dtype=np.int64)
        columns = _still_columns(specimen, pixel_size_pm, drift)
    truth = movie_truth(found[0].shape, drift, **columns).assign_attrs(
        pixel_size_pm=pixel_size_pm,
        frame_time_s=frame_time_s,
        shape=list(found[0].shape),
        dose=dose,
        contrast=contrast,
        vacuum_counts=vacuum,
        seed=seed,
        microscope=to_toml(microscope),
    )
    pictured = PicturedScene(found, state, drift, vacuum, contrast)
    write_movie(path, truth, pictured.expected_counts, pictured.limits)
    return truth


def _moving_ceria(
    scene: Scene, microscope: Microscope
) -> tuple[list[Picture], np.ndarray[Any, np.dtype[np.int64]], dict[str, np.ndarray[Any, Any]]]:
    """Return the multislice version of a scene: its pictures, which of them a frame shows, and its columns.

    The cerium of every frame is where the scene has it; oxygen follows from the cerium that is there at most.
    """
    size, drift, surface = scene.pixel_size_pm, scene.drift, scene.surface
    whole, column = surface_specimen(surface, scene.shape[0] * size, scene.shape[1] * size)
    moved_px = np.stack([scene.y - surface.y / size - drift[:, :1], scene.x - surface.x / size - drift[:, 1:]], axis=-1)
    arrangement = np.concatenate([moved_px.round(9).reshape(len(drift), -1), scene.atoms > 0], axis=1)
    states, state = np.unique(arrangement, axis=0, return_inverse=True)
    found = []
    for row in states:
        move, there = row[: -surface.x.size].reshape(-1, 2), row[-surface.x.size :] > 0
        found.append(_picture(_rearranged(whole, column, move * size / 100, there), microscope, size, drift))
    cerium, oxygen = surface.kind == "Ce", _still_columns(whole, size, drift, kind="O")
    kept: dict[str, np.ndarray[Any, Any]] = {
        "x": scene.x,
        "y": scene.y,
        "atoms": scene.atoms,
        "kind": surface.kind,
        "role": scene.role,
    }
    columns = {name: np.concatenate([values[..., cerium], oxygen[name]], axis=-1) for name, values in kept.items()}
    return found, state.ravel(), columns


def _picture(specimen: Specimen, microscope: Microscope, pixel_size_pm: float, drift: np.ndarray[Any, Any]) -> Picture:
    border = BORDER_PM + float(np.abs(drift).max()) * pixel_size_pm
    return pictures(specimen, microscope, pixel_size_pm, border_pm=border)[0]


def _rearranged(
    specimen: Specimen, column: np.ndarray[Any, Any], move: np.ndarray[Any, Any], there: np.ndarray[Any, Any]
) -> Specimen:
    """Return the specimen with its columns moved by ``move`` (column, (y, x)) in angstroms, or gone."""
    atoms = specimen.atoms.copy()
    owned = np.flatnonzero(column >= 0)
    atoms.positions[owned, :2] += move[column[owned], ::-1]
    gone = owned[~there[column[owned]]]
    del atoms[gone.tolist()]
    return replace(specimen, atoms=atoms)


def _still_columns(
    specimen: Specimen, pixel_size_pm: float, drift: np.ndarray[Any, Any], *, kind: str = ""
) -> dict[str, np.ndarray[Any, Any]]:
    """Return the columns of a specimen (of one kind) that only drift, as :func:`movie_truth` takes them."""
    columns = projected_columns(specimen, pixel_size_pm)
    if kind:
        columns = columns.isel(column_id=columns["kind"].to_numpy() == kind)
    atoms = columns["atoms"].to_numpy()
    return {
        "x": columns["x_ref"].to_numpy() + drift[:, 1:],
        "y": columns["y_ref"].to_numpy() + drift[:, :1],
        "atoms": np.repeat(atoms[None], len(drift), axis=0),
        "kind": columns["kind"].to_numpy().astype(str),
        "role": np.full(atoms.size, "static", dtype="<U7"),
    }
