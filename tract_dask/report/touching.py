"""What a report says of columns that touch: those that were fitted each alone, and pairs that are hardly told apart."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..kernels.gaussian.joint import MOST_MEMBERS
from ..stages.groups import groups_of, touching
from .finding import count, named
from .survey import Survey

BLIND = 0.25
"""Share of a pair's distance that the stated error of a position may have."""


def alone_words(run: Survey) -> dict[str, Any] | None:
    """Return what there is to say of touching columns that were fitted each alone; None where none was."""
    numbers = groups_of(run.tracks["fit_ref"].to_numpy())
    together = run.tracks["group"].to_numpy() if "group" in run.tracks else np.zeros_like(numbers)
    alone = (numbers > 0) & (together == 0)
    likelihood = run.settings is not None and run.settings.fit.estimator == "poisson"
    if likelihood:
        alone = numbers > 0
    if not alone.any():
        return None
    ids = run.tracks["column_id"].to_numpy()[alone].tolist()
    why = "maximum likelihood (estimator poisson) fits each column alone" if likelihood else "they were given as such"
    text = (
        f"{count(len(ids), 'column')} touch a neighbour (column {named(ids)}), and {why}: the neighbour pulls at the "
        "position, and adds to the intensity, by more than the errors say."
    )
    remedy = (
        "Run again with --estimator lsq, which fits touching columns together."
        if likelihood
        else f"Run again with columns that are found, not given; groups have at most {MOST_MEMBERS} columns."
    )
    return {"title": "Touching columns were fitted each alone", "text": text, "remedy": remedy}


def unresolved_words(run: Survey) -> dict[str, Any] | None:
    """Return what there is to say of pairs whose distance is not much larger than its error; None where all are."""
    columns = run.tracks["fit_ref"].to_numpy()
    first, second, _ = touching(columns)
    if not first.size:
        return None
    places = np.stack([run.tracks["x_ref"], run.tracks["y_ref"]], axis=-1) * run.known.scale
    distance = np.hypot(*(places[first] - places[second]).T)
    error = run.columns["expected"].to_numpy()
    with np.errstate(invalid="ignore"):
        blind = np.maximum(error[first], error[second]) > BLIND * distance
    if not blind.any():
        return None
    ids = run.tracks["column_id"].to_numpy()
    pairs = [f"{ids[one]}-{ids[other]}" for one, other in zip(first[blind], second[blind], strict=True)]
    text = (
        f"{count(len(pairs), 'pair')} of touching columns ({named(pairs)}) cannot be told apart in a single frame: the "
        f"stated errors of their positions are more than {BLIND:.0%} of their distance."
    )
    remedy = "Sum frames (rebin_frames), or keep one column of each pair in columns.csv, for both."
    return {"title": "Pairs of columns are not resolved in single frames", "text": text, "remedy": remedy}
