"""Noise-free images by multislice, with abTEM: vacuum is 1, positions are known.

abTEM calculates the potential and the exit wave and applies the lens; what it returns is kept as a Fourier series, so
that an image can be sampled anywhere, exactly. abTEM and ASE are optional (``pip install "tract_dask[simulate]"``) and
are imported only where they are needed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray as xr
from scipy import fft
from scipy.spatial import cKDTree

from ..errors import SettingsError
from ..settings.toml import to_toml
from .settings import PRESETS, Microscope
from .structures import SAME_COLUMN_PM, Specimen, projected_columns, require_simulators

if TYPE_CHECKING:
    from ase import Atoms

BORDER_PM = 500.0
"""Vacuum around everything, so that the periodic images of a calculation do not reach one another."""

FINEST_SAMPLING_PM = 5.0
"""Pixels of the calculation are not larger than this; those of the image are a whole number of them."""

MOST_SLICE_PM = 200.0
"""Slices are not thicker than this."""

_INSIDE = 1e-3
_LARGEST_GRID = 16_384


@dataclass(frozen=True)
class Picture:
    """A noise-free image as a Fourier series: vacuum is 1.

    ``spectrum`` is that of an image of ``grid`` pixels, of which every ``stride``-th from ``origin`` on is a pixel of
    the field, ``shape`` of them; pairs are (y, x).
    """

    spectrum: np.ndarray[Any, np.dtype[np.complex64]]
    grid: tuple[int, int]
    stride: int
    origin: tuple[int, int]
    shape: tuple[int, int]

    def sample(self, shift: tuple[float, float] = (0.0, 0.0)) -> np.ndarray[Any, np.dtype[np.float32]]:
        """Return the field (y, x), its content moved by ``shift`` (y, x) in px of the field, by the shift theorem."""
        spectrum = self.spectrum
        if any(shift):
            ky = fft.fftfreq(self.grid[0])[:, None] * (shift[0] * self.stride)
            kx = fft.rfftfreq(self.grid[1])[None] * (shift[1] * self.stride)
            spectrum = spectrum * (np.exp(-2j * np.pi * ky) * np.exp(-2j * np.pi * kx)).astype(np.complex64)
        whole = fft.irfft2(spectrum, s=self.grid)
        (top, left), (rows, columns), step = self.origin, self.shape, self.stride
        field: np.ndarray[Any, np.dtype[np.float32]] = whole[
            top : top + rows * step : step, left : left + columns * step : step
        ]
        return np.ascontiguousarray(field)

    @cached_property
    def range(self) -> tuple[float, float]:
        """Smallest and largest value, the surroundings of the field included."""
        whole = fft.irfft2(self.spectrum, s=self.grid)
        return float(whole.min()), float(whole.max())


def multislice_image(
    specimen: Specimen, microscope: Microscope = PRESETS["paper"], *, pixel_size_pm: float = 4.0
) -> xr.Dataset:
    """Return the noise-free image of a specimen with the truth about its columns.

    Parameters
    ----------
    specimen
        From :mod:`tract_dask.simulate.structures`.
    microscope
        Its settings.
    pixel_size_pm
        Of the image. A pixel has the value at its centre: no detector is modelled.

    Returns
    -------
    Dataset
        ``image`` (y, x), float32, vacuum = 1, and ``x_ref``, ``y_ref`` (px), ``kind``, ``atoms`` (column_id) of every
        column inside the field. Attributes: ``pixel_size_pm``, and ``microscope`` as TOML.

    Raises
    ------
    SettingsError
        Where the pixel size is out of range, or the field takes too many pixels.
    InputError
        Where abTEM or ASE are not installed.
    """
    picture = pictures(specimen, microscope, pixel_size_pm)[0]
    columns = projected_columns(specimen, pixel_size_pm)
    return _with_image(columns, ("y", "x"), picture.sample(), microscope)


def thickness_series(
    specimen: Specimen, microscope: Microscope = PRESETS["paper"], *, pixel_size_pm: float = 4.0
) -> xr.Dataset:
    """Return the images of a slab of 1, 2, ... periods, up to the whole ``specimen``, from one calculation.

    Returns
    -------
    Dataset
        As :func:`multislice_image`, with ``image`` (n_periods, y, x) and ``atoms`` (n_periods, column_id). A column
        that has one atom a period, as Ce and O have in CeO2 along [110], has n of them in n periods.

    Raises
    ------
    SettingsError
        Where the specimen has no period, and as :func:`multislice_image`.
    """
    if specimen.period_pm is None:
        raise SettingsError(
            "a structure that is taken as it is has no thickness to vary",
            "thickness_series",
            "a slab or a block",
            "no period along the beam",
            "Give a crystal and its zone axis",
        )
    found = pictures(specimen, microscope, pixel_size_pm, series=True)
    images = np.stack([picture.sample() for picture in found])
    columns = projected_columns(specimen, pixel_size_pm)
    atoms = ("n_periods", "column_id"), _atoms_by_period(specimen, columns, len(found)), columns["atoms"].attrs
    columns = columns.assign(atoms=atoms).assign_coords(n_periods=np.arange(1, len(found) + 1))
    return _with_image(columns, ("n_periods", "y", "x"), images, microscope)


def pictures(
    specimen: Specimen,
    microscope: Microscope,
    pixel_size_pm: float,
    *,
    series: bool = False,
    border_pm: float = BORDER_PM,
) -> list[Picture]:
    """Return the specimen's image, or with ``series`` those after every period, as Fourier series.

    At least ``border_pm`` around the field and the atoms belongs to the calculation, and can drift into the field.
    The potential is that of Lobato's parametrisation, smeared by the thermal displacement and projected slice by slice;
    the wave is band-limited to two thirds of the grid's (abTEM). Raises as :func:`multislice_image`.
    """
    require_simulators()
    if not 0.5 <= pixel_size_pm <= 100.0:
        raise SettingsError(
            "the size of a pixel is out of range", "multislice: pixel_size_pm", "0.5 to 100", f"{pixel_size_pm:g}"
        )
    stride = math.ceil(pixel_size_pm / FINEST_SAMPLING_PM)
    fine = pixel_size_pm / stride
    shape = round(specimen.height_pm / pixel_size_pm), round(specimen.width_pm / pixel_size_pm)
    places = specimen.atoms.positions[:, 1::-1] * 100  # y, x
    before = border_pm + np.maximum(0.0, -places.min(axis=0))
    after = border_pm + np.maximum(np.multiply(shape, pixel_size_pm), places.max(axis=0))
    origin = np.ceil(before / fine).astype(int)
    rows, columns = (int(fft.next_fast_len(int(n))) for n in origin + np.ceil(after / fine).astype(int))
    if max(rows, columns) > _LARGEST_GRID:
        raise SettingsError(
            "the calculation would take too many pixels",
            "multislice",
            f"at most {_LARGEST_GRID} a side",
            f"{rows} x {columns} of {fine:g} pm",
            "Make the field smaller or the pixels larger",
        )
    atoms, thicknesses, every = _sliced(specimen, origin[::-1] * fine, (columns * fine, rows * fine))
    intensities = _intensities(atoms, (columns, rows), thicknesses, every if series else None, microscope)
    ky, kx = fft.fftfreq(rows)[:, None], fft.rfftfreq(columns)[None]
    vibration = np.exp(-2 * (np.pi * microscope.vibration_pm / fine) ** 2 * (ky**2 + kx**2)).astype(np.float32)
    return [
        Picture(
            (fft.rfft2(image) * vibration).astype(np.complex64),
            (rows, columns),
            stride,
            (int(origin[0]), int(origin[1])),
            shape,
        )
        for image in intensities
    ]


def _sliced(
    specimen: Specimen, origin_pm: np.ndarray[Any, Any], extent_pm: tuple[float, float]
) -> tuple[Atoms, tuple[float, ...], int]:
    """Return the atoms in their cell, the thicknesses of the slices in angstroms, and the slices of one period."""
    atoms = specimen.atoms.copy()
    z = atoms.positions[:, 2]
    if specimen.period_pm is None:
        z -= z.min()
        period, n_periods = float(z.max()) + 2 * _INSIDE, 1
    else:
        period = specimen.period_pm / 100
        n_periods = math.ceil((float(z.max()) + _INSIDE) / period)
    per_period = math.ceil(period * 100 / MOST_SLICE_PM)
    depth = n_periods * period
    z[:] = np.clip(z + _INSIDE, 0.0, depth - _INSIDE)  # off the boundaries between slices
    atoms.positions[:, :2] += origin_pm / 100
    atoms.set_cell([extent_pm[0] / 100, extent_pm[1] / 100, depth])
    atoms.set_pbc(True)
    return atoms, (period / per_period,) * (per_period * n_periods), per_period


def _intensities(
    atoms: Atoms,
    gpts: tuple[int, int],
    thicknesses: tuple[float, ...],
    every: int | None,
    microscope: Microscope,
) -> list[np.ndarray[Any, np.dtype[np.float32]]]:
    """Return the image (y, x) at the exit face, or those after ``every`` so many slices."""
    import abtem
    from abtem.parametrizations import LobatoParametrization

    quiet = {"diagnostics.progress_bar": False, "dask.lazy": False, "fftw.planning_effort": "FFTW_ESTIMATE"}
    with abtem.config.set(quiet):
        displacements = dict.fromkeys(set(atoms.get_chemical_symbols()), microscope.thermal_pm / 100)
        potential = abtem.Potential(
            atoms,
            gpts=gpts,
            slice_thickness=thicknesses,
            parametrization=LobatoParametrization(sigmas=displacements),
            projection="infinite",
            exit_planes=every,
        )
        waves = abtem.PlaneWave(energy=microscope.energy_kev * 1e3).multislice(potential, lazy=False)
        lens = abtem.CTF(
            energy=microscope.energy_kev * 1e3,
            semiangle_cutoff=microscope.aperture_mrad,
            soft=True,
            focal_spread=microscope.focal_spread_nm * 10,
            angular_spread=microscope.angular_spread_mrad,
            C10=microscope.defocus_nm * 10,
            C30=microscope.spherical_um * 1e4,
            C50=microscope.fifth_order_mm * 1e7,
        )
        images = np.asarray(waves.apply_ctf(lens).intensity().array, dtype=np.float32)
    images = images.swapaxes(-1, -2)  # abTEM has x first
    return list(images[1:]) if every else [images]  # the first exit plane is the entrance face


def _atoms_by_period(specimen: Specimen, columns: xr.Dataset, n_periods: int) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Return how many atoms of each column are in the first 1, 2, ... periods, (n_periods, columns)."""
    places = np.stack([columns["x_ref"], columns["y_ref"]], axis=1) * columns.attrs["pixel_size_pm"]
    distance, column = map(np.asarray, cKDTree(places).query(specimen.atoms.positions[:, :2] * 100))
    inside = distance < SAME_COLUMN_PM
    period = np.floor((specimen.atoms.positions[:, 2] + _INSIDE) * 100 / specimen.period_pm).astype(int)
    counts = np.zeros((n_periods, len(places)), dtype=np.int64)
    np.add.at(counts, (np.clip(period[inside], 0, n_periods - 1), column[inside]), 1)
    return counts.cumsum(axis=0)


def _with_image(
    columns: xr.Dataset, dims: tuple[str, ...], image: np.ndarray[Any, Any], microscope: Microscope
) -> xr.Dataset:
    attributes = {"units": "1", "long_name": "Intensity, vacuum = 1", "pixel_size_pm": columns.attrs["pixel_size_pm"]}
    return columns.assign(image=(dims, image, attributes)).assign_attrs(microscope=to_toml(microscope))
