"""What a report says of columns that touch: those that were fitted each alone, and pairs that are hardly told apart."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..kernels.gaussian.joint import MOST_MEMBERS
from ..stages.groups import UNRESOLVED, groups_of, touching
from .finding import count, named
from .survey import Survey

SHARED = 1.0
"""Error that all frames share, over that of a mean over frames, from which it is told."""


def alone_words(run: Survey) -> dict[str, Any] | None:
    """Return what there is to say of touching columns that were fitted each alone; None where none was."""
    numbers = groups_of(run.tracks["fit_ref"].to_numpy())
    together = run.tracks["group"].to_numpy() if "group" in run.tracks else np.zeros_like(numbers)
    alone = (numbers > 0) & (together == 0)
    if not alone.any():
        return None
    ids = run.tracks["column_id"].to_numpy()[alone].tolist()
    text = (
        f"{count(len(ids), 'column')} touch a neighbour (column {named(ids)}), and they were given as such: "
        "the neighbour pulls at the position, and adds to the intensity, by more than the errors say."
    )
    remedy = f"Run again with columns that are found, not given; groups have at most {MOST_MEMBERS} columns."
    return {"title": "Touching columns were fitted each alone", "text": text, "remedy": remedy}


def half_words(run: Survey) -> dict[str, Any] | None:
    """Return what there is to say of given columns that touch one that was not given; None where there is none."""
    ids = run.found.get("one_of_two")
    if not ids:
        return None
    text = (
        f"{count(len(ids), 'given column')} ({named(ids)}) {_be(ids)} one of two that touch, as the sum shows. "
        "The other one pulls at the position, and adds to the intensity, by more than the errors say."
    )
    remedy = "Leave out --columns-csv, so that both are found, or give both."
    return {"title": "Given columns are one of two that touch", "text": text, "remedy": remedy}


def unresolved_words(run: Survey) -> dict[str, Any] | None:
    """Return what there is to say of columns that one frame cannot tell apart; None where all are resolved."""
    one, pairs = _fitted_as_one(run), _hardly_apart(run)
    if not one and not pairs:
        return None
    text = ""
    if one:
        text += (
            f"{count(len(one), 'column')} ({named(one)}) {_be(one)} two or more that the summed image resolves and one "
            "frame does not: each was fitted as one, at the middle of both, and is marked "
            "unresolved in the tracks. "
        )
    if pairs:
        text += (
            f"{count(len(pairs), 'pair')} of touching columns ({named(pairs)}) cannot be told apart in a single frame: "
            f"the stated errors of their positions are more than {UNRESOLVED:.0%} of their distance."
        )
    remedy = "Sum frames (rebin_frames) to see both, or keep one column of each pair in columns.csv, for both."
    return {"title": "Pairs of columns are not resolved in single frames", "text": text.strip(), "remedy": remedy}


def shared_words(run: Survey) -> dict[str, Any] | None:
    """Return what there is to say of places that err alike in all frames; None where means hardly feel it.

    A frame's error s leaves s / sqrt(n) to a mean of n frames, and what is shared, a times s, stays.
    """
    share = run.about.get("shared_place_error") or 0.0
    ids = run.tracks["column_id"].to_numpy()
    together = run.tracks["group"].to_numpy() > 0 if "group" in run.tracks else np.zeros(len(ids), np.bool_)
    number = run.columns["accepted"].to_numpy()[together]
    if not number.size or share * np.sqrt(np.median(number)) <= SHARED:
        return None
    usual = float(np.nanmedian(run.columns["expected"].to_numpy()[together]))
    of_mean = np.sqrt(1 + share**2 * np.median(number))
    text = (
        f"{count(len(number), 'column')} touch a neighbour, and their positions depend on the widths that the summed "
        f"image gave them: {share * usual:.2g} {run.known.unit} of error (rms) is the same in all frames. Stated "
        f"errors leave it out: that of one frame is too small by a factor of {np.hypot(1, share):.2f}, that of a mean "
        f"over all by {of_mean:.1f}."
    )
    remedy = "Changes from frame to frame are free of it. Count it in distances between these columns."
    return {"title": "Touching columns err alike in all frames", "text": text, "remedy": remedy}


def _fitted_as_one(run: Survey) -> list[int]:
    """Return the IDs of columns that are a fit of more than one."""
    if "unresolved" not in run.tracks:
        return []
    alone = run.tracks["unresolved"].to_numpy() & (run.tracks["group"].to_numpy() == 0)
    return [int(number) for number in run.tracks["column_id"].to_numpy()[alone]]


def _hardly_apart(run: Survey) -> list[str]:
    """Return the pairs whose stated errors are large beside their distance."""
    first, second, _ = touching(run.tracks["fit_ref"].to_numpy())
    places = np.stack([run.tracks["x_ref"], run.tracks["y_ref"]], axis=-1) * run.known.scale
    distance = np.hypot(*(places[first] - places[second]).T)
    error = run.columns["expected"].to_numpy()
    with np.errstate(invalid="ignore"):
        blind = np.maximum(error[first], error[second]) > UNRESOLVED * distance
    ids = run.tracks["column_id"].to_numpy()
    return [f"{ids[one]}-{ids[other]}" for one, other in zip(first[blind], second[blind], strict=True)]


def _be(ids: list[int]) -> str:
    return "is" if len(ids) == 1 else "are"
