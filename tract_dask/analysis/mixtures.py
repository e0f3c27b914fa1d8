"""Groups of columns by their intensities alone, for those who have no simulated images: a Gaussian mixture.

After A. De Backer et al., *Ultramicroscopy* 134 (2013) 23, as in StatSTEM: columns of one number of atoms scatter about
one intensity, with a width that all have in common; the number of groups is that with the smallest integrated
classification likelihood.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import xarray as xr
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage

from ..errors import SettingsError
from ..kernels.gaussian.intensity import Floats

_RANDOM_STARTS = 12
_FIRST_STEPS = 30
"""Steps of EM from every start; the likeliest goes on."""
_MOST_STEPS = 2000
_SETTLED = 1e-7
"""EM ends when a step gains less than this in log likelihood for each column."""
_NARROWEST = 1e-3
"""The width stays above this share of the intensities' range, or any two equal ones would make a group."""


class _Fit(NamedTuple):
    """Mixtures of one number of groups, (starts, ...)."""

    location: Floats
    weight: Floats
    width: Floats
    log_likelihood: Floats


def mixture(intensity: xr.DataArray, max_components: int = 12, *, criterion: str = "icl") -> xr.Dataset:
    """Sort columns into groups of like intensity, and find how many groups there are.

    Parameters
    ----------
    intensity
        (column_id,) one intensity for each column, in any unit: a mean over frames, say. NaN are left out.
    max_components
        Most groups that are tried; no more than a third of the columns.
    criterion
        ``icl`` or ``bic``: that by which the number of groups is chosen. BIC finds groups that overlap, and more that
        are not there.

    Returns
    -------
    xr.Dataset
        On ``component``, brightest last: ``location``, ``location_stderr`` and ``weight``; ``width``, which all share;
        ``icl`` and ``bic`` on ``n_components``; on ``column_id`` ``assigned`` (the component, from 1; 0 where the
        intensity is NaN) and ``probability`` (column_id, component).

    Raises
    ------
    SettingsError
        Where ``intensity`` is not one number a column, or there are fewer than six columns.

    Notes
    -----
    EM starts from clusters of several kinds and from random columns (a fixed seed), all at once; the best is kept.
    With d = 2 G parameters for G groups (locations, weights that add to 1, a width), BIC = -2 log L + d log n, and
    ICL = BIC + 2 E with E the entropy of the assignment (Biernacki, Celeux and Govaert 2000).

    What it cannot do: component k is k atoms only where every number from 1 on is there; where intensity falls again
    with thickness, two numbers share a group; groups nearer than about two widths become one; with few columns a
    group the number of groups is uncertain. It knows nothing of the error of each column.

    Examples
    --------
    >>> values = np.repeat([1.0, 2.0, 3.0], 20) + 0.1 * np.sin(np.arange(60))
    >>> groups = mixture(xr.DataArray(values, dims="column_id"))
    >>> groups.location.values.round(1).tolist()
    [1.0, 2.0, 3.0]
    """
    values, known, most = _checked(intensity, criterion, max_components)
    fits = [_best(values[known], n) for n in range(1, most + 1)]
    bic = np.array([-2 * fit.log_likelihood + 2 * n * np.log(known.sum()) for n, fit in enumerate(fits, start=1)])
    shares = [_membership(values[known], fit)[0] for fit in fits]
    icl = bic + 2 * np.array([_entropy(share) for share in shares])
    chosen = int(np.argmin(icl if criterion == "icl" else bic))
    fit, share = fits[chosen], shares[chosen]
    probability = np.full((len(values), chosen + 1), np.nan)
    probability[known] = share.T
    assigned = np.zeros(len(values), np.int64)
    assigned[known] = np.argmax(share, axis=0) + 1
    unit = intensity.attrs.get("units", "1")
    variables = {
        "location": ("component", fit.location, unit, "Intensity of the group"),
        "location_stderr": (
            "component",
            fit.width / np.sqrt(share.sum(axis=1)),
            unit,
            "Standard error of the location",
        ),
        "weight": ("component", fit.weight, "1", "Share of the columns"),
        "width": ((), float(fit.width), unit, "Standard deviation within a group, common to all"),
        "icl": ("n_components", icl, "1", "Integrated classification likelihood; the smallest is best"),
        "bic": ("n_components", bic, "1", "Bayesian information criterion; the smallest is best"),
        "assigned": ("column_id", assigned, "1", "Most probable component; 0 where there is no intensity"),
        "probability": (("column_id", "component"), probability, "1", "Probability of each component"),
    }
    coordinates = {"component": np.arange(1, chosen + 2), "n_components": np.arange(1, most + 1)}
    return xr.Dataset(
        {
            name: (dims, data, {"units": unit, "long_name": text})
            for name, (dims, data, unit, text) in variables.items()
        },
        coordinates | {name: array for name, array in intensity.coords.items() if name == "column_id"},
    )


def _checked(intensity: xr.DataArray, criterion: str, max_components: int) -> tuple[Floats, NDArray[np.bool_], int]:
    """Return the intensities, which of them are known, and the most components that they allow."""
    if criterion not in ("icl", "bic"):
        raise SettingsError("the criterion cannot be used", "mixture", "icl or bic", repr(criterion))
    if intensity.dims != ("column_id",):
        raise SettingsError(
            "there is not one intensity for each column",
            "mixture: intensity",
            "dimensions ('column_id',)",
            str(intensity.dims),
            "Take the mean over the frames, or a frame",
        )
    values = intensity.to_numpy().astype(np.float64)
    known = np.isfinite(values)
    most = min(max_components, int(known.sum()) // 3)
    if most < 2 or not np.ptp(values[known]) > 0:
        raise SettingsError(
            "there are too few columns to sort",
            "mixture: intensity",
            "six different intensities or more, and two components",
            f"{known.sum()} intensities, {max_components} components",
            "Use a look-up table instead",
        )
    return values, known, most


def _best(values: Floats, n: int) -> _Fit:
    """Return the likeliest mixture of ``n`` groups, locations ascending, without the axis of the starts."""
    tried = _climb(values, _maximised(values, _starts(values, n)), _FIRST_STEPS)
    best = int(np.argmax(tried.log_likelihood))
    fit = _climb(values, _Fit(*(field[best : best + 1] for field in tried)), _MOST_STEPS)
    order = np.argsort(fit.location[0])
    return _Fit(fit.location[0][order], fit.weight[0][order], fit.width[0], fit.log_likelihood[0])


def _climb(values: Floats, fit: _Fit, most_steps: int) -> _Fit:
    for _ in range(most_steps):
        before, fit = fit, _step(values, fit)
        if np.all(fit.log_likelihood - before.log_likelihood < _SETTLED * len(values)):
            break
    return fit


def _starts(values: Floats, n: int) -> Floats:
    """Return assignments to start from, (starts, n, values) of 0 and 1.

    They are Ward's clusters, those between the widest gaps, those nearest to equally spaced intensities and quantiles,
    and those nearest to random columns.
    """
    middle = (np.arange(n) + 0.5) / n
    random = np.random.default_rng(n)
    drawn = [random.choice(values, n, replace=False) for _ in range(_RANDOM_STARTS)]
    places = np.array([np.quantile(values, middle), values.min() + np.ptp(values) * middle, *drawn])
    labels = [np.argmin(np.abs(values - place[:, None]), axis=0) for place in places]
    trees = [linkage(values[:, None], method) for method in ("ward", "single")]
    labels += [fcluster(tree, n, criterion="maxclust") - 1 for tree in trees]
    return np.asarray(np.array(labels)[:, None, :] == np.arange(n)[:, None], dtype=np.float64)


def _membership(values: Floats, fit: _Fit) -> tuple[Floats, Floats]:
    """Return the probability of each group, (..., n, values), and the log likelihood, (...)."""
    width = np.asarray(fit.width)[..., None, None]
    with np.errstate(divide="ignore"):
        logs = np.log(fit.weight)[..., None] - 0.5 * ((values - fit.location[..., None]) / width) ** 2
    logs -= np.log(width) + 0.5 * np.log(2 * np.pi)
    largest = logs.max(axis=-2, keepdims=True)
    share = np.exp(logs - largest)
    total = share.sum(axis=-2, keepdims=True)
    return share / total, (largest + np.log(total)).sum(axis=(-2, -1))


def _step(values: Floats, fit: _Fit) -> _Fit:
    """Return the mixtures after a step of EM; their log likelihoods are those before it."""
    share, log_likelihood = _membership(values, fit)
    return _maximised(values, share)._replace(log_likelihood=log_likelihood)


def _maximised(values: Floats, share: Floats) -> _Fit:
    """Return the likeliest mixtures for memberships (starts, n, values)."""
    count = share.sum(axis=-1)
    location = (share @ values) / np.maximum(count, 1e-300)
    variance = (share * (values - location[..., None]) ** 2).sum(axis=(-2, -1)) / len(values)
    width = np.maximum(np.sqrt(variance), _NARROWEST * np.ptp(values))
    return _Fit(location, count / len(values), width, np.full(len(width), -np.inf))


def _entropy(share: Floats) -> float:
    """Return how unsure the assignment is, in nats, summed over the columns."""
    return float(-(share * np.log(np.maximum(share, 1e-300))).sum())
