"""What a report says of the crystal as a whole: how it turned, and which columns moved against the others."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..kernels.linear_motion import moved
from .finding import count, named
from .survey import Survey

BLURRED = 0.25
"""Share of the columns' sigma by which a motion may carry the farthest ones about in the summed image."""
SOME = 0.1
"""Share of the columns that must move by themselves, where the crystal turns as well, to be told."""
MANY = 0.5
"""Share of the columns that must stand still for the others to be those that move."""
SHARED = 0.1
"""Share of a column's fits on the atom of another one that is worth a warning."""


def slip_words(run: Survey) -> dict[str, Any] | None:
    """Return what there is to say of columns that moved against the others; None where a single one did, or none."""
    moving, number = run.about.get("not_reference") or (), run.tracks.sizes["column_id"]
    if len(moving) < 2 or (run.about.get("motions_undone") and len(moving) < SOME * number):
        return None
    few = len(moving) > (1 - MANY) * number
    text = (
        f"{len(moving):,} of {number:,} columns did not keep their distances from the others. Positions are relative "
        "to the largest part that did: it stands still by definition."
    )
    remedy = "Half of the columns or more moved: look which part is the reference (fit.drift_columns)." if few else ""
    return {
        "title": "A part of the columns moved against the others",
        "text": text,
        "remedy": remedy,
        "serious": few,
    }


def left_out_words(run: Survey) -> dict[str, Any] | None:
    """Return what there is to say of sublattices that were seen and left out; None where none was."""
    left = run.found.get("left_out")
    if not left:
        return None
    near = [one for one in left if one["why"] == "near"]
    faint = [one for one in left if one["why"] == "faint"]
    sentences = []
    if near:
        number, nearest = sum(one["number"] for one in near), min(one["distance_px"] for one in near)
        sentences.append(
            f"{number:,} places that come back in every cell are {nearest:.3g} px from brighter columns, too near for "
            "columns that are fitted with as large windows."
        )
    if faint:
        number, share = sum(one["number"] for one in faint), max(one["share"] for one in faint)
        sentences.append(f"{number:,} columns of fainter kinds have {share:.0%} of the amplitude of the others.")
    remedies = ["Give --min-amplitude below that share to have the faint ones."] if faint else []
    remedies += ["Near ones are found by --columns-method maxima, or given in a table (--columns-csv)."] if near else []
    return {
        "title": "Faint columns between the others were left out",
        "text": " ".join(sentences),
        "remedy": " ".join(remedies),
        "serious": False,
    }


def hop_words(run: Survey) -> dict[str, Any] | None:
    """Return what there is to say of columns that left their places and were found elsewhere; None where none did."""
    number, ids = run.columns["hopped"].to_numpy(), run.columns["column_id"].to_numpy()
    if not number.any():
        return None
    most = ids[np.argsort(-number, kind="stable")][: int((number > 0).sum())]
    text = (
        f"{count(int(number.sum()), 'fit')} of {count(len(most), 'column')} ({named(most.tolist())}) were found beyond "
        "the bounds of the usual fit: these columns had left their places, and are followed there."
    )
    remedy = "Look at them in the movie: what is found might be another atom. fit.search_px=0 follows none."
    return {"title": "Columns hopped", "text": text, "remedy": remedy, "serious": False}


def same_atom_words(run: Survey) -> dict[str, Any] | None:
    """Return what there is to say of columns whose fits lie on the atom of another column; None where none does."""
    number, ids = run.columns["same_atom"].to_numpy(), run.columns["column_id"].to_numpy()
    often = number > SHARED * np.maximum(run.columns["fits"].to_numpy(), 1)
    if not often.any():
        return None
    text = (
        f"In more than {SHARED:.0%} of their fits {count(int(often.sum()), 'column')} ({named(ids[often].tolist())}) "
        "lie on the atom of another column, which is nearer to its own place. These fits are not accepted."
    )
    remedy = "Is an atom named twice? Then remove one of both from columns.csv and run again."
    return {"title": "Columns share an atom", "text": text, "remedy": remedy}


def row_words(run: Survey) -> dict[str, Any] | None:
    """Return what there is to say of displaced rows that positions are freed from; None where none was looked for."""
    if "row_offset" not in run.tracks:
        return None
    offset, error, shift = (
        float((run.tracks[name] ** 2).mean().compute()) for name in ("row_offset", "row_offset_stderr", "row_shift")
    )
    places = float((run.tracks["stderr"].sel(parameter="x") ** 2).mean().compute())
    text = (
        f"Rows of the frames were displaced along x by {np.sqrt(offset + error):.2g} px (rms), and columns by "
        f"{np.sqrt(shift):.2g} px. x is freed from that (row_offset and row_shift in the results). Errors of y and of "
        "intensities still hold the noise that displaced rows leave, and are too large."
    )
    few = not shift > places
    remedy = "That is less than the errors of places: leave out --scan-rows." if few else ""
    how = run.settings.fit.scan_rows if run.settings is not None else ""
    summed = how == "sum" and not few
    if how == "lattice":
        text += " Displacements that columns share with their row of the lattice are taken for offsets, too."
    if summed:
        left = np.sqrt(shift / run.tracks.sizes["frame"])
        text += f" The summed image keeps about {left:.2g} px of the offsets, which means of x over frames share."
        remedy = "For means over frames run again with --scan-rows lattice."
    return {"title": "Offsets of scanned rows were undone", "text": text, "remedy": remedy, "serious": summed}


def motion_words(run: Survey) -> dict[str, Any] | None:
    """Return what there is to say of a crystal that turned, grew or sheared; None where none did."""
    undone = run.about.get("motions_undone")
    if not undone:
        return None
    motion = run.frames["motion"].to_numpy()
    ends = np.ptp(np.nan_to_num(motion), axis=0)
    sizes = [f"turned by {np.rad2deg(ends[0]):.2g} degrees"] if "rotation" in undone else []
    sizes += [f"grew or shrank by {ends[1]:.2g} times its size"] if "magnification" in undone else []
    sizes += [f"sheared by {max(ends[2:]):.2g}"] if "shear" in undone else []
    places = np.stack([run.tracks["x_ref"], run.tracks["y_ref"]], axis=-1) - np.array(run.tracks.attrs["motion_centre"])
    carried = moved(places, motion)
    farthest = float(np.linalg.norm(carried.std(axis=0), axis=-1).max())
    sigma = float(np.nanmedian(run.tracks["fit_ref"].sel(parameter=["sigma_a", "sigma_b"])))
    text = f"The crystal {' and '.join(sizes)} over the movie. Positions are freed from that (motion in the results)."
    blurred = farthest > BLURRED * sigma
    if blurred:
        text += (
            f" The summed image is not: it shows the columns farthest from the middle blurred by {farthest:.1f} px, "
            "and their amplitudes and intensities are off."
        )
    return {
        "title": "The crystal turned or changed its size",
        "text": text,
        "remedy": "Run parts of the movie one by one (--frames) for the intensities of these columns." * blurred,
        "serious": blurred,
    }
