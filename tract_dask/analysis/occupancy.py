"""The number of atoms in each column, with what is known of it (section 2.6 and Figures 5 and 6 of the paper).

For each number n the measured intensity is compared with what n atoms would show, and the probabilities of all numbers
follow by Bayes' rule.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike
from scipy.stats import norm

from ..errors import SettingsError
from ..kernels.gaussian.intensity import intensities
from ..kernels.gaussian.model import blurred
from ..kernels.gaussian.parameters import AMPLITUDE
from ..kernels.windows import blur_variance
from ..settings.run import FitSettings
from ..store.results import accepted, fitted_with, weakest
from ..store.schema import NOT_SEEN, Status
from .intensity import UNIT, normalised, shape_error
from .likelihood import CONFIDENCE, Levels, credible_sets, probabilities
from .lookup import intensity_bound, look_up_table, read_table, write_table
from .motion import pixel_size_pm, standard_deviation

__all__ = ["count_atoms", "dose_to_be_sure", "look_up_table", "read_table", "write_table"]

_ALIKE = 0.1
"""Windows and blurs of table and tracks may differ by this share."""
_WINDOW_SLOPE = 0.5
"""A window that is wider by some share shows up to this much of it less intensity, for neighbours shine in (CeO2)."""
_PAIRS, _SEEN, _BRIGHT = 10, 0.9, 4.0
"""Differences between frames, share of accepted fits, and mean over scatter, from which on differences tell an error.

Of faint columns fits are missing, and those of none at all scatter less than their error."""
_ERRORS = {"stderr": "intensity_stderr", "poisson": "intensity_error"}


def count_atoms(
    tracks: xr.Dataset,
    table: xr.Dataset,
    vacuum: xr.Dataset | xr.DataArray | float,
    *,
    frames: str = "each",
    error: str = "scatter",
    noise_scale: float = 1.0,
    table_error: float = 0.01,
    max_atoms: int | None = None,
    prior: ArrayLike | None = None,
    threshold: float = FitSettings().threshold,
) -> xr.Dataset:
    """Return how many atoms each column has, in each frame or in their mean, and how sure that is.

    Parameters
    ----------
    tracks
        Of :func:`tract_dask.open_results`, or those that :func:`tract_dask.accepted` returns.
    table
        Of :func:`look_up_table` or :func:`read_table`, made with the settings of the fit.
    vacuum
        Of :func:`tract_dask.analysis.intensity.vacuum_level`, for all frames or each, or the counts in a pixel.
    frames
        ``each``, or ``mean``: from the mean intensity of the frames in which the column was accepted.
    error
        Of an intensity: ``scatter``, from its differences between successive frames, or as ``stderr`` where there are
        less than ten, a tenth of the fits is not accepted, or the column is faint; ``stderr``, from its fit;
        ``poisson``, Equation 5; ``repeated``, its standard deviation over the frames, with all that the column does.
    noise_scale
        Factor on that error, where you know it to be larger or smaller.
    table_error
        Error of the table's intensities as a share of them, on top of their range over the sites. 0.01 is what
        neighbours of other thickness do, as at steps; how well the simulation meets the experiment is for you to say.
        Where the table's windows were of another size, half the difference, as a share, is added in quadrature.
    max_atoms
        Largest number that is possible; without it, the table's. The paper excludes the falling branch (7 and more)
        because its oxygen columns are faint.
    prior
        Probability of 0, 1, … atoms up to the largest number, up to a factor; all are equal without it.
    threshold
        As in the fit, or in :func:`tract_dask.accepted`.

    Returns
    -------
    xr.Dataset
        On (frame, column_id), or (column_id): ``atoms``, the most probable number; ``low_68``, ``high_68``, ``low_95``,
        ``high_95``, the smallest and largest member of the smallest set of numbers that holds 68 % or 95 % of the
        probability; ``ambiguous``, whether the set of 95 % has a gap, or members on both sides of the brightest number
        (which is one of them, as 5 of 5 and 6); and ``probability`` with the further dimension ``n_atoms``. All
        are lazy where the tracks are. NaN where the fit says nothing: the window left the frame, the frame is bad, or
        the fit failed for another reason than weakness.

    Raises
    ------
    SettingsError
        Where an argument cannot be used, the pixel size is missing, or table and tracks were fitted differently.

    Notes
    -----
    With mu the table's intensity of n atoms, s the error of the measured one, and t what all frames have in common
    (half the table's range over the sites, ``table_error`` mu, and where shapes are fixed their error in the summed
    image), the likelihood is normal, with mean sqrt(mu^2 + 2 s^2) and variance s^2 + t^2. A fit looks for its place and
    so finds one that is too bright: that is the 2 s^2, which adds s^2 / mu. Where there is no column, mean and standard
    deviation are 1.65 s and 0.62 s. A fit too weak to be accepted counts with the probability that n atoms give such a
    one. The mean over accepted frames has lost its faint ones: mean and variance are then those of a normal
    distribution cut off at the threshold.
    """
    _check_choice("frames", frames, ("each", "mean"))
    _check_choice("error", error, ("scatter", *_ERRORS, "repeated"))
    shared_error = float(np.hypot(table_error, _WINDOW_SLOPE * _check_together(tracks, table)))
    levels = _levels(table, max_atoms, shared_error, prior)
    sign = float(np.sign(table["intensity"].mean()))
    good = accepted(tracks)
    unit = _unit(tracks, vacuum)
    measured = normalised(good, vacuum)
    intensity = sign * measured["intensity"]
    sigma = noise_scale * _sigma(measured, error)
    reference = _reference(tracks, noise_scale)
    expected = xr.DataArray(reference["sigma"] / unit)
    limit = weakest(good, threshold) * reference["area"] / unit
    weak = ((good["status"] & np.uint8(Status.BELOW_NOISE)) != 0) & ((good["status"] & np.uint8(NOT_SEEN)) == 0)
    if frames == "each":
        error_of_each = xr.where(weak, expected, sigma)
        inputs: tuple[Any, ...] = (intensity, error_of_each, limit, weak, xr.ones_like(intensity))
    else:
        inputs = _means(intensity, sigma, expected, limit, weak)
    probability = xr.apply_ufunc(
        probabilities,
        *inputs,
        reference["shape_error"],
        kwargs={"levels": levels, "chosen": frames == "mean"},
        output_core_dims=[["n_atoms"]],
        dask="parallelized",
        output_dtypes=[np.float32],
        dask_gufunc_kwargs={"output_sizes": {"n_atoms": len(levels.numbers)}},
    ).assign_coords(n_atoms=levels.numbers)
    return _summary(probability, levels)


def _means(
    intensity: xr.DataArray, sigma: xr.DataArray, expected: xr.DataArray, limit: xr.DataArray, weak: xr.DataArray
) -> tuple[xr.DataArray, ...]:
    """Return what :func:`probabilities` takes for the means over the frames in which the columns were accepted."""
    seen = intensity.notnull()
    n = seen.sum("frame")
    never = (n == 0) & weak.any("frame")
    mean_sigma = xr.DataArray(np.exp(xr.DataArray(np.log(sigma)).mean("frame")))  # of free shapes a few errors are huge
    mean_expected = expected.mean(set(expected.dims) - {"column_id"})
    limits = limit.where(seen | never).mean("frame")
    return intensity.mean("frame"), mean_sigma.where(n > 0, mean_expected), limits, never, n


def dose_to_be_sure(
    table: xr.Dataset,
    n: int | None = None,
    *,
    within: int = 0,
    confidence: float = 0.95,
    error: str = "poisson",
    noise_scale: float = 1.0,
    table_error: float = 0.0,
    max_atoms: int | None = None,
) -> xr.Dataset:
    """Return the dose of a frame from which on the number of atoms in a column is known.

    Parameters
    ----------
    table
        Of :func:`look_up_table`: it has the variances that go with the intensities.
    n
        Atoms in the column; None: all numbers of the table.
    within
        Numbers as near as this to the true one need not be told from it: 0 for n itself, the paper's "less than ±1
        atom"; 1 for n ± 1.
    confidence
        Of the interval that must not reach another number's intensity.
    error
        ``poisson``: Equation 5, the paper's; ``fit``: the smallest error that a fit can have.
    noise_scale, table_error, max_atoms
        As in :func:`count_atoms`.

    Returns
    -------
    xr.Dataset
        On ``atoms``: ``dose`` (e/A^2; infinite where the table itself does not tell numbers apart), ``step`` to the
        nearest intensity of a number that it must be told from, 0 included, and ``spread``, the standard deviation that
        no dose lessens.

    Raises
    ------
    SettingsError
        Where an argument cannot be used, or the table has no variances.

    Notes
    -----
    The variance of an intensity in units of 1 A^2 of vacuum is v / dose: with Equation 5, v = I + 8 pi B sigma_a
    sigma_b in these units. Sure is sqrt(v / dose + spread^2) <= step / 1.96 at 95 %. The paper reads "> 2500 e/A^2"
    for 3 atoms off its Figure 6c.
    """
    name = f"variance_{error}"
    _check_choice("error", error, ("poisson", "fit"))
    if not 0 < confidence < 1:
        raise SettingsError("the confidence cannot be used", "confidence", "between 0 and 1", f"{confidence:g}")
    if name not in table:
        raise SettingsError(
            "the look-up table does not know how its intensities vary with dose",
            "dose_to_be_sure: table",
            f"a variable {name}",
            ", ".join(map(str, table.data_vars)),
            "Make the table with look_up_table",
        )
    levels = _levels(table, max_atoms, table_error, None)
    numbers, spread = levels.numbers[1:], levels.spread[1:]
    if n is not None and n not in numbers:
        raise SettingsError("the look-up table lacks this number", "dose_to_be_sure: n", str(numbers.tolist()), str(n))
    away = np.abs(levels.intensity[1:, None] - levels.intensity)
    away[np.abs(numbers[:, None] - levels.numbers) <= within] = np.inf
    step = away.min(axis=1)
    room = (step / norm.ppf(0.5 + confidence / 2)) ** 2 - spread**2
    variance = noise_scale**2 * table[name].sel(atoms=numbers).to_numpy()
    dose = np.where(room > 0, variance / np.where(room > 0, room, 1), np.inf)
    values = {
        "dose": (dose, "e/A^2", f"Dose of a frame that tells the number of atoms with {confidence:.0%} confidence"),
        "step": (step, UNIT, "Difference to the nearest intensity of a number to be told from it"),
        "spread": (spread, UNIT, "Standard deviation that does not depend on dose"),
    }
    return xr.Dataset(
        {name: ("atoms", array, {"units": unit, "long_name": text}) for name, (array, unit, text) in values.items()},
        {"atoms": numbers},
    ).sel(atoms=numbers if n is None else [n])


def _check_choice(name: str, value: str, choices: tuple[str, ...]) -> None:
    if value not in choices:
        raise SettingsError(f"{name} cannot be used", "occupancy", f"one of {', '.join(choices)}", repr(value))


def _check_together(tracks: xr.Dataset, table: xr.Dataset) -> float:
    """Check that table and tracks come from fits of one kind, as far as both say so.

    Returns
    -------
    float
        The share by which their windows differ; 0 where nobody knows.
    """
    size = pixel_size_pm(tracks)
    for name, unit in (("window", "px"), ("window_blur", "px"), ("estimator", ""), ("intensity_scale", "")):
        ours = tracks.attrs.get(f"{name}_{unit}" if unit else name)
        theirs = table.attrs.get(f"{name}_pm" if unit else name)
        if ours is None or theirs is None:
            continue
        if (abs(ours * size - theirs) > _ALIKE * theirs) if unit else ours != theirs:
            raise SettingsError(
                f"the look-up table was fitted with another {name}",
                "count_atoms: table",
                f"{ours * size:g} pm" if unit else str(ours),
                f"{theirs:g} pm" if unit else str(theirs),
                "Make the table with the settings of the fit",
            )
    ours, theirs = tracks.attrs.get("window_px"), table.attrs.get("window_pm")
    return 0.0 if ours is None or theirs is None else abs(ours * size / theirs - 1)


def _levels(table: xr.Dataset, max_atoms: int | None, relative: float, prior: ArrayLike | None) -> Levels:
    known = table[["intensity", "low", "high"]].dropna("atoms").sortby("atoms")
    known = known.sel(atoms=known["atoms"] <= (max_atoms or np.inf))
    numbers = np.concatenate([[0], known["atoms"].to_numpy()])
    if len(numbers) < 2:
        raise SettingsError(
            "the look-up table has no number of atoms that is possible",
            "occupancy: table",
            f"numbers up to {max_atoms}" if max_atoms else "at least one number",
            ", ".join(map(str, table["atoms"].to_numpy())) or "none",
        )
    intensity = np.abs(np.concatenate([[0.0], known["intensity"].to_numpy()]))
    half = np.concatenate([[0.0], (known["high"] - known["low"]).to_numpy() / 2])
    share = np.ones(len(numbers)) if prior is None else np.asarray(prior, np.float64)
    if share.shape != numbers.shape or not (share >= 0).all() or not share.sum() > 0:
        raise SettingsError(
            "the prior cannot be used",
            "count_atoms: prior",
            f"{len(numbers)} probabilities, for {', '.join(map(str, numbers))} atoms",
            f"{share.tolist()}",
        )
    with np.errstate(divide="ignore"):
        log_prior = np.log(share / share.sum())
    return Levels(numbers, intensity, np.hypot(half, relative * intensity), log_prior)


def _unit(tracks: xr.Dataset, vacuum: xr.Dataset | xr.DataArray | float) -> xr.DataArray:
    """Return the counts in 1 A^2 of vacuum, for all frames or each."""
    level = vacuum["level"] if isinstance(vacuum, xr.Dataset) else xr.DataArray(vacuum)
    return level / (pixel_size_pm(tracks) / 100) ** 2


def _sigma(measured: xr.Dataset, error: str) -> xr.DataArray:
    """Return the error of each accepted intensity; NaN elsewhere."""
    intensity = measured["intensity"]
    if error == "repeated":
        return standard_deviation(intensity) * xr.ones_like(intensity).where(intensity.notnull())
    if error == "scatter":
        step = abs(intensity - intensity.shift(frame=1))
        seen = intensity.notnull()
        scatter: xr.DataArray = np.sqrt(np.pi) / 2 * step.mean("frame")
        enough = (step.notnull().sum("frame") >= _PAIRS) & (seen.mean("frame") >= _SEEN)
        enough &= abs(intensity.mean("frame")) >= _BRIGHT * scatter
        filled: xr.DataArray = (xr.ones_like(intensity) * scatter.where(enough)).where(seen)
        return filled.fillna(measured["intensity_stderr"])
    return measured[_ERRORS[error]]


def _reference(tracks: xr.Dataset, noise_scale: float) -> xr.Dataset:
    """Return what is known of each column before its frames are looked at, from the fit on the summed image.

    They are the ``area`` by which an amplitude becomes an intensity, the ``sigma`` to be expected of an intensity, both
    in counts, and the ``shape_error`` that all frames have in common, as a share of the intensity.
    """
    fits = tracks["fit_ref"].to_numpy().astype(np.float64)
    fits = np.where(np.isnan(fits), np.nanmedian(fits, axis=0), fits)
    sharp = blurred(fits, -blur_variance(fitted_with(tracks, "reference_blur_px")))
    window_px, held = fitted_with(tracks, "window_px"), fitted_with(tracks, "shape") == "fixed"
    bound = intensity_bound(sharp, window_px, fixed_shape=held)
    as_fitted = blurred(sharp, blur_variance(fitted_with(tracks, "window_blur_px")))
    intensity = np.abs(intensities(as_fitted, fitted_with(tracks, "intensity_scale"))[0])
    values = {
        "area": intensity / np.abs(as_fitted[:, AMPLITUDE]),
        "sigma": noise_scale * bound * intensity,
        "shape_error": noise_scale * np.nan_to_num(np.asarray(shape_error(tracks)) * bound),
    }
    columns = {"column_id": tracks["column_id"]}
    return xr.Dataset({name: ("column_id", array) for name, array in values.items()}, columns)


def _summary(probability: xr.DataArray, levels: Levels) -> xr.Dataset:
    names = ("atoms", *(f"{end}_{level:.0%}"[:-1] for level in CONFIDENCE for end in ("low", "high")), "ambiguous")
    parts = xr.apply_ufunc(
        credible_sets,
        probability,
        kwargs={"numbers": levels.numbers, "brightest": int(np.argmax(levels.intensity))},
        input_core_dims=[["n_atoms"]],
        output_core_dims=[[]] * len(names),
        dask="parallelized",
        output_dtypes=[np.float32] * 5 + [np.bool_],
    )
    counts = xr.Dataset(dict(zip(names, parts, strict=True)) | {"probability": probability})
    texts = {"atoms": "Most probable number of atoms", "ambiguous": "Whether the set of 95 % is not one run of numbers"}
    texts["probability"] = "Probability of each number of atoms"
    for level in CONFIDENCE:
        texts[f"low_{level:.0%}"[:-1]] = f"Smallest member of the set of numbers that holds {level:.0%}"
        texts[f"high_{level:.0%}"[:-1]] = f"Largest member of the set of numbers that holds {level:.0%}"
    for name, text in texts.items():
        counts[name].attrs = {"units": "1", "long_name": text}
    return counts
