"""What a crystal does as a whole, from the fits of all frames: which columns are its reference, and how it turns.

Frames are fitted one by one, and each takes off the shift that most of its columns share. Over the whole movie more can
be told. A part of the columns may have slipped against the others: then those stand still that are most, and keep their
mutual distances. Or the crystal turns, grows or shears: then no column moves by itself, and positions are freed from
it. Which of these is true is a question of likelihood, with a price for each number that an answer needs (Schwarz,
Ann. Stat. 6, 461, 1978); where neither is, positions stay as they were fitted.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import StoreError
from ...kernels import linear_motion
from ...kernels.gaussian.parameters import THETA, X, Y
from ...store import schema
from ...store.journal import Journal
from ...store.parts import AGAIN, DamagedPartError, Parts, layout
from .common_motion import errors_of, still
from .job import Job

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

CHANGED = ("fit", "centroid", "drift", "motion", "status")
"""The variables that are put right."""

_EPOCHS = 16
"""The movie is looked at in so many parts, over which positions are averaged."""

_MOST_SHARDS, _FEWEST_SHARDS, _MOST_FITS = 64, 4, 3_000_000
"""So many shards tell of the whole movie; fewer where they hold more fits than this."""

_FITS_AT_ONCE = 1 << 19
"""Positions are put right for so many fits at a time."""

_FEWEST_FRAMES = 3
"""In fewer frames nothing is told."""

_KINDS = ((0,), (1,), (2, 3))
"""The numbers of a linear motion that are taken or left together."""

_FEW_COLUMNS = 0.25
"""By so much squares exceed 1 where the error of a motion in one frame comes from ten columns only."""

_LEAST = 0.1
"""Share of a column's error in one frame from which a motion of the farthest column is worth to be undone."""

_STRANGE = 3.72
"""Standard deviations beyond which something is no chance: it happens once in 10,000 times."""

_FEWEST_COLUMNS, _MOST_BODIES = 3, 4
"""Fewest columns of a rigid body, and most bodies."""

_LARGEST_STEP = 3.0
"""Standard errors from which a shift of the reference counts."""


@dataclass(frozen=True)
class Crystal:
    """How positions are put right.

    Attributes
    ----------
    motions
        Which of the four numbers of a linear motion are undone.
    reference
        (columns,) which columns stand still by definition.
    centre
        (x, y) about which motions are, px.
    places
        (columns, 2) in the summed image, from the centre.
    expected
        (columns,) errors of positions, up to a factor.
    """

    motions: tuple[int, ...]
    reference: Bools
    centre: Floats
    places: Floats
    expected: Floats

    @classmethod
    def of(cls, motions: tuple[int, ...], reference: Bools, job: Job) -> Crystal:
        """Return it for the columns of a job."""
        return cls(motions, reference, job.centre, job.from_centre, errors_of(job.reference))

    def told(self, job: Job) -> dict[str, Any]:
        """Return what the store of results says of it."""
        moving = job.columns["column_id"].to_numpy()[~self.reference].tolist()
        found = {} if job.settings.drift_columns is not None else {"not_reference": moving}
        return {"motions_undone": [linear_motion.NAMES[k] for k in self.motions], **found}

    def put_right(self, values: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        """Return :data:`CHANGED` of some frames from their fits as :func:`.measure.measure` returns them.

        Frames that show too few columns of the reference cannot be put right: they are lost frames.
        """
        step = max(1, _FITS_AT_ONCE // len(self.reference))
        starts = range(0, len(values["fit"]), step)
        parts = [self._put_right({name: of[k : k + step] for name, of in values.items()}) for k in starts]
        return {name: np.concatenate([part[name] for part in parts]) for name in CHANGED}

    def _put_right(self, values: dict[str, NDArray[Any]]) -> dict[str, NDArray[Any]]:
        good = still(values["status"]) & self.reference
        fit, centroid, drift = values["fit"].copy(), values["centroid"].copy(), values["drift"].copy()
        seen = fit[..., [X, Y]] - self.centre
        shift, motion = linear_motion.fit(seen, self.places, self.expected, good, self.motions)
        for array, order in ((fit, [X, Y]), (centroid, [1, 0])):
            away = array[..., order] - self.centre - shift[:, None]
            array[..., order] = self.centre + linear_motion.moved(away, -motion)
        fit[..., THETA] += motion[:, :1]
        bad = (values["status"] & schema.Status.BAD_FRAME).any(axis=1)
        few = (good.sum(axis=1) < linear_motion.fewest(self.motions)) & ~bad
        status = values["status"] | np.where(few, schema.Status.LOST_FRAME, 0).astype(np.uint16)[:, None]
        return {"fit": fit, "centroid": centroid, "drift": drift + shift[:, ::-1], "motion": motion, "status": status}


def judged(journal: Journal, path: Path, job: Job) -> Crystal | None:
    """Return how positions of the store at ``path`` are put right, from the parts of its journal; see :func:`judge`.

    Raises
    ------
    DamagedPartError
        Where parts are damaged: fit their shards again.
    """
    frames, step, _ = layout(path)
    parts = Parts.of(journal, frames, step)
    try:
        return judge(parts, frames, step, job)
    except StoreError as error:
        parts.strike_damaged()
        raise DamagedPartError(error.what, error.where, got=error.got, remedy=AGAIN) from error


def named(job: Job) -> Crystal | None:
    """Return how positions are put right by the columns that the settings name; None where they name none."""
    if job.settings.drift_columns is None:
        return None
    return Crystal.of((), np.isin(job.columns["column_id"], job.settings.drift_columns), job)


def judge(parts: Parts, frames: int, step: int, job: Job) -> Crystal | None:
    """Return how positions of a movie are put right; None where they stay as they are.

    Parameters
    ----------
    parts
        All fits, of so many ``frames`` in shards of ``step``.
    """
    if (chosen := named(job)) or job.refined_by is None or frames < _FEWEST_FRAMES:
        return chosen
    measured, stderr = (_of_all(parts, name, frames, step) for name in ("motion_measured", "motion_stderr"))
    seen = _Seen.of(parts, frames, step, job)
    if seen is None:
        return None
    price = np.log(max(2, np.isfinite(seen.mean).sum()))
    bodies = _bodies(seen, price)
    kinds = tuple(k for kind in _KINDS if _moves(measured[:, kind], stderr[:, kind], seen, job) for k in kind)
    if kinds:
        turned, cost = _turning(seen, job, kinds, price)
        if cost < bodies.cost or not bodies.counts:
            return Crystal.of(kinds, turned, job)
    return Crystal.of((), bodies.reference, job) if bodies.counts else None


@dataclass(frozen=True)
class _Seen:
    """Mean displacements of columns in parts of the movie.

    Attributes
    ----------
    mean
        (epochs, columns, 2) as (x, y), less that of the whole movie; NaN where a column is not seen.
    variance
        (epochs, columns) of it, along one axis.
    single
        (columns,) variance of one fit.
    """

    mean: Floats
    variance: Floats
    single: Floats

    @classmethod
    def of(cls, parts: Parts, frames: int, step: int, job: Job) -> _Seen | None:
        """Return what some shards tell; None where no column is seen often enough."""
        shards = np.flatnonzero(parts.done)
        most = int(np.clip(_MOST_FITS // (step * len(job.reference)), _FEWEST_SHARDS, _MOST_SHARDS))
        shards = shards[np.unique(np.linspace(0, len(shards) - 1, most).round().astype(int))]
        fit = np.empty((step, len(job.reference), schema.SIZES["parameter"]))
        status = np.empty(fit.shape[:2], np.uint16)
        places, numbers = [], []
        for shard in shards.tolist():
            here = min(step, frames - shard * step)
            parts.read(shard, "fit", fit)
            parts.read(shard, "status", status)
            good = still(status[:here])
            places.append(np.where(good[..., None], fit[:here, :, [X, Y]], np.nan))
            numbers.append(shard * step + np.arange(here))
        away = np.concatenate(places) - job.reference[:, [X, Y]]
        number = np.concatenate(numbers)
        epochs = np.array_split(np.arange(len(number)), min(_EPOCHS, max(2, len(number) // 4)))
        return cls.averaged(away, epochs, errors_of(job.reference))

    @classmethod
    def averaged(cls, away: Floats, epochs: list[NDArray[np.int64]], expected: Floats) -> _Seen | None:
        """Return it from displacements (frames, columns, 2), with errors (columns,) that are known up to a factor.

        A few frames show a scatter that is much too small by chance, so none is taken to be smaller than expected.
        """
        seen = np.isfinite(away[..., 0])
        count = np.array([seen[part].sum(axis=0) for part in epochs])
        total = np.array([np.nansum(away[part], axis=0) for part in epochs])
        with np.errstate(invalid="ignore", divide="ignore"):
            mean = total / count[..., None]
            left = np.concatenate([away[part] - mean[k] for k, part in enumerate(epochs)])
            free = np.maximum(count - 1, 0).sum(axis=0)
            single = np.nansum(left**2, axis=(0, 2)) / (2 * free)
        few = ~(free >= 2)
        if few.all():
            return None
        usual = np.median(single[~few] / expected[~few] ** 2)
        single = np.fmax(single, usual * expected**2)
        mean[:, few] = np.nan
        variance = single / np.maximum(count, 1)
        weight = np.where(np.isfinite(mean[..., 0]), count, 0)
        middle = np.nansum(mean * weight[..., None], axis=0) / np.maximum(weight.sum(axis=0), 1)[:, None]
        return cls(mean - middle, variance, single)

    @property
    def counted(self) -> Bools:
        """(columns,) which are seen in two parts at least."""
        return np.asarray(np.isfinite(self.mean[..., 0]).sum(axis=0) >= 2)


@dataclass(frozen=True)
class _Bodies:
    """The columns as rigid bodies that only shift: which make the largest, what this answer costs, and if it counts."""

    reference: Bools
    cost: float
    counts: bool


def _squares(left: Floats, seen: _Seen) -> tuple[Floats, Floats]:
    """Return chi-squared of each column's displacements over the parts, about their mean, and its freedom."""
    weight = np.where(np.isfinite(left[..., 0]), 1 / seen.variance, 0)
    values = np.where(weight[..., None] > 0, left, 0)
    mean = (weight[..., None] * values).sum(axis=0) / np.maximum(weight.sum(axis=0), 1e-300)[:, None]
    chi = (weight[..., None] * (values - mean) ** 2).sum(axis=(0, 2))
    return chi, 2.0 * np.maximum((weight > 0).sum(axis=0) - 1, 0)


def _improbable(chi: Floats, free: Floats) -> Bools:
    """Tell which chi-squared are larger than by chance."""
    return np.asarray(chi > np.maximum(free, 1) * _beyond_chance(np.maximum(free, 1)))


def _beyond_chance(free: Any) -> Any:
    """Return which mean of so many squares is passed once in 10,000 times (Wilson and Hilferty, PNAS 17, 684, 1931)."""
    return (1 - 2 / (9 * free) + _STRANGE * np.sqrt(2 / (9 * free))) ** 3


def _mean_of(seen: _Seen, which: Bools) -> tuple[Floats, Floats]:
    """Return the mean displacement of columns in each part, (epochs, 2), and the standard error of an axis."""
    there = np.isfinite(seen.mean[:, which, 0])
    weight = np.where(there, 1 / seen.variance[:, which], 0)
    total = np.maximum(weight.sum(axis=1), 1e-300)
    mean = (weight[..., None] * np.where(there[..., None], seen.mean[:, which], 0)).sum(axis=1) / total[:, None]
    return mean, 1 / np.sqrt(total)


def _away(seen: _Seen, which: Bools) -> Floats:
    """Return chi-squared of each column against the mean motion of some of them, (columns,)."""
    mean, _ = _mean_of(seen, which)
    return _squares(seen.mean - mean[:, None], seen)[0]


def _halves(seen: _Seen, body: Bools, price: float) -> list[Bools]:
    """Return two bodies into which one falls, where they explain the motion of its columns enough better; else none.

    The first cut is along the strongest common motion; then columns go to the half that they move with, some times.
    """
    if body.sum() < 2 * _FEWEST_COLUMNS:
        return []
    mean, _ = _mean_of(seen, body)
    left = np.nan_to_num((seen.mean - mean[:, None])[:, body] / np.sqrt(seen.variance[:, body])[..., None])
    _, _, scores = np.linalg.svd(np.swapaxes(left, 1, 2).reshape(-1, left.shape[1]), full_matrices=False)
    first = np.zeros_like(body)
    first[body] = scores[0] > 0
    for _ in range(20):
        second = body & ~first
        if min(first.sum(), second.sum()) < _FEWEST_COLUMNS:
            return []
        one, other = _away(seen, first), _away(seen, second)
        new = body & (one < other)
        if (new == first).all():
            break
        first = new
    alone = price * _squares(seen.mean, seen)[1]  # what a column costs that moves by itself
    gain = float((np.minimum(_away(seen, body), alone) - np.minimum(np.minimum(one, other), alone))[body].sum())
    numbers, columns = 2 * (len(seen.mean) - 1), body.sum()
    by_chance = 2 / np.pi * (1 + np.sqrt(numbers / columns)) ** 2  # a column's gain by the best cut through noise
    worth = price * numbers + columns * max(np.log(2), by_chance)
    return [first, body & ~first] if gain > worth else []


def _bodies(seen: _Seen, price: float) -> _Bodies:
    """Return the columns as rigid bodies that only shift; columns of no body move by themselves."""
    undivided, bodies = [seen.counted], list[Bools]()
    while undivided:
        body = undivided.pop()
        halves = _halves(seen, body, price) if len(bodies) + len(undivided) + 2 <= _MOST_BODIES else []
        undivided += halves
        bodies += [] if halves else [body]
    cost, alone = len(seen.single) * np.log(len(bodies)), np.zeros_like(seen.counted)
    _, free = _squares(seen.mean, seen)
    for k, body in enumerate(bodies):
        alone |= body & _improbable(_away(seen, body), free)
        bodies[k] = body & ~alone
        cost += float(_away(seen, bodies[k])[bodies[k]].sum()) + price * 2 * (len(seen.mean) - 1)
    cost += price * float(free[alone].sum())
    reference = max(bodies, key=lambda body: int(body.sum()))
    mean, error = _mean_of(seen, reference)
    away = np.abs(mean - mean.mean(axis=0)).max(axis=1) / error
    return _Bodies(reference, cost, len(bodies) > 1 and bool((away > _LARGEST_STEP).any()))


def _turning(seen: _Seen, job: Job, kinds: tuple[int, ...], price: float) -> tuple[Bools, float]:
    """Return which columns move with a crystal that turns, grows or shears, and what this answer costs."""
    good = np.isfinite(seen.mean[..., 0]) & seen.counted
    places = np.where(good[..., None], seen.mean, 0) + job.from_centre
    shift, motion = linear_motion.fit(places, job.from_centre, np.sqrt(seen.single), good, kinds)
    left = np.where(good[..., None], places - shift[:, None] - linear_motion.moved(job.from_centre, motion), np.nan)
    chi, free = _squares(left, seen)
    turned = seen.counted & ~_improbable(chi, free)
    cost = float(np.minimum(chi, price * free)[seen.counted].sum()) + price * (2 + len(kinds)) * (len(seen.mean) - 1)
    return turned, cost


def _moves(measured: Floats, stderr: Floats, seen: _Seen, job: Job) -> bool:
    """Tell whether motions (frames, k) stand out of their errors, frame by frame or part by part.

    The farthest column must move by a tenth of its error in one frame at least.
    """
    reach = np.hypot(*job.from_centre.T).max()
    usual = np.sqrt(np.median(seen.single))
    known = np.isfinite(measured).all(axis=1) & (stderr > 0).all(axis=1)
    if known.sum() < _FEWEST_FRAMES:
        return False
    values, weight = measured[known], 1 / stderr[known] ** 2
    middle = (weight * values).sum(axis=0) / weight.sum(axis=0)
    for size in {1, *(max(1, len(values) // parts) for parts in (_EPOCHS, _EPOCHS // 2, _EPOCHS // 4))}:
        groups = np.array_split(np.arange(len(values)), max(2, len(values) // size))
        total = np.array([weight[group].sum(axis=0) for group in groups])
        mean = np.array([(weight[group] * (values - middle)[group]).sum(axis=0) for group in groups]) / total
        squares = float((mean**2 * total).mean())
        errors = float((1 / total).mean())
        true = max(0.0, float((mean**2).mean()) - errors)
        far = np.sqrt(true) * reach > _LEAST * usual
        if far and squares > _beyond_chance(mean.size) + _FEW_COLUMNS / size:
            return True
    return False


def _of_all(parts: Parts, name: str, frames: int, step: int) -> Floats:
    """Return a variable of all frames."""
    rest = [schema.SIZES[dim] for dim in schema.RESULTS[name].dims[1:]]
    values, piece = np.empty((frames, *rest)), np.empty((step, *rest))
    for shard in np.flatnonzero(parts.done).tolist():
        parts.read(shard, name, piece)
        values[shard * step : (shard + 1) * step] = piece[: frames - shard * step]
    return values
