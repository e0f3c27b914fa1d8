"""Hard scenes, tracked and scored against their truth: ``python -m benchmarks.cases.scenes.scenes NAME...``.

Pixels of 8 pm are meant, columns of sigma 5 px at 40 px, 40 frames, 3.2 counts a pixel (500 e/A^2) and 45 % contrast,
unless the scene says otherwise. Right: all columns found and none besides, a bias well below the rmse, a pull of 1.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

from tract_dask.analysis.jumps import change_points

from ..common import Floats, Scene, crystal, lattice, score, track, walk, work_folder
from .bounds import bound

WINDOW = 21


@dataclass(frozen=True)
class Trial:
    """A movie, its truth, and the settings to track it with; ``unit``: detector units an electron."""

    name: str
    scene: Scene
    counts: NDArray[Any]
    fit: dict[str, Any] = field(default_factory=dict)
    columns: dict[str, Any] = field(default_factory=dict)
    tolerance: float = 6.0
    border: float = 25.0
    unit: float = 1.0

    def cut(self, n_frames: int) -> Trial:
        """Return the same with no more than the first frames."""
        scene = replace(self.scene, places=self.scene.places[:n_frames], amplitudes=self.scene.amplitudes[:n_frames])
        return replace(self, scene=scene, counts=self.counts[:n_frames])


def plain() -> Iterator[Trial]:
    """Nothing special; by each way of fitting."""
    scene, _ = crystal()
    for fit in ({}, {"estimator": "poisson"}, {"shape": "free"}, {"refine_drift": False}):
        yield Trial(f"plain {fit}", scene, scene.counts(), fit)


def pairs() -> Iterator[Trial]:
    """Pairs of equal columns, ever closer. Right: two columns or one, not two that are drawn together."""
    for apart in (3.5, 3.0, 2.5, 2.0, 1.6, 1.2):
        rng, sigma, shape = np.random.default_rng(3), 5.0, (320, 360)
        rows, across = np.meshgrid(np.arange(20.0, shape[0], 54.0), np.arange(20.0, shape[1], 76.0), indexing="ij")
        middles = np.stack([across + np.where(np.arange(len(rows))[:, None] % 2, 38.0, 0.0), rows], axis=-1)
        half = np.array([apart * sigma / 2, 0.0])
        sites = np.concatenate([middles.reshape(-1, 2) - half, middles.reshape(-1, 2) + half])
        places = sites + walk(40, 0.35, rng)[:, None]
        scene = Scene(places, np.full(places.shape[:2], 0.45 * 6), sigma, 6.0, shape)
        yield Trial(f"pairs {apart} sigma apart", scene, scene.counts(), tolerance=0.45 * apart * sigma)


def hot_pixels() -> Iterator[Trial]:
    """Pixels that are hot in every frame, or in one. Right: scores as of `plain`."""
    scene, _ = crystal()
    for number, value in ((3, 200), (10, 200), (60, 65535)):
        counts = scene.counts()
        y, x = np.random.default_rng(4).integers(0, scene.shape, (number, 2)).T
        counts[:, y, x] = value
        yield Trial(f"{number} pixels of {value} in every frame", scene, counts)
    counts, rng = scene.counts(), np.random.default_rng(5)
    for frame in counts:
        y, x = rng.integers(0, scene.shape, (30, 2)).T
        frame[y, x] = rng.integers(30, 400, 30)
    yield Trial("30 other pixels of 30 to 400 in every frame", scene, counts)


def wedge() -> Iterator[Trial]:
    """The specimen gets thicker to the right: heights by a factor of 5, the background by 2 or 4."""
    scene, _ = crystal()
    thick = scene.amplitudes * (0.3 + 1.2 * scene.places[..., 0] / scene.shape[1])
    for steep in (1.0, 3.0):
        ramp = 3.2 * (1 + steep * (np.arange(scene.shape[1]) / scene.shape[1]) ** 2)
        own = replace(scene, amplitudes=thick, background=np.broadcast_to(ramp, scene.shape))
        yield Trial(f"wedge, background by {1 + steep:.0f}", own, own.counts())


def cameras() -> Iterator[Trial]:
    """Detector units of 7.3 for an electron with an offset and read noise; and a blur of the camera's own."""
    scene, _ = crystal()
    electrons = scene.counts().astype(float)
    noise = np.random.default_rng(6).normal(0, 5, electrons.shape)
    units = np.clip(electrons * 7.3 + 100 + noise, 0, 65535).round().astype("u2")
    for fit in ({}, {"estimator": "poisson"}):
        yield Trial(f"units of 7.3, offset 100 {fit}", scene, units, fit, unit=7.3)
    for blur in (0.5, 1.2, 2.0):
        blurred = np.stack([gaussian_filter(frame, blur, mode="wrap") for frame in electrons]) * 20
        yield Trial(f"camera that blurs by {blur} px", scene, blurred.astype("f4"), unit=20.0)


def fields_that_turn() -> Iterator[Trial]:
    """The field rotates or grows, and no column moves by itself. Right: as few jumps as in `plain`."""
    scene, drift = crystal()
    middle = np.array(scene.shape[::-1]) / 2
    still = scene.places[0] - middle
    time = np.linspace(-0.5, 0.5, len(drift))
    for degrees in (0.3, 1.0, 3.0):
        angle = np.deg2rad(degrees * time)
        turns = np.stack([np.cos(angle), -np.sin(angle), np.sin(angle), np.cos(angle)], axis=-1).reshape(-1, 2, 2)
        yield _moved(f"turns by {degrees} degrees", scene, np.einsum("fij,kj->fki", turns, still) + middle, drift)
    for growth in (0.003, 0.01, 0.03):
        yield _moved(f"grows by {growth:.1%}", scene, still * (1 + growth * time)[:, None, None] + middle, drift)


def hops() -> Iterator[Trial]:
    """Every ninth column hops to and fro. Right: jumps of these sizes at these columns only."""
    scene, _ = crystal()
    for hop in (5.0, 7.5, 10.0):
        places = scene.places.copy()
        places[10:25, ::9, 0] += hop
        yield Trial(
            f"hops of {hop} px", replace(scene, places=places), replace(scene, places=places).counts(), tolerance=9
        )


def vacuum_that_is_darker() -> Iterator[Trial]:
    """As in HAADF: the vacuum is dark. A third of the columns comes and goes. Right: absent ones are not accepted."""
    scene, _ = crystal(background=6.4, contrast=0.3, top=120.0)
    rng = np.random.default_rng(1)
    flips = np.cumsum(rng.random(scene.amplitudes.shape) < 0.1, axis=0) % 2 == 1
    absent = flips & (np.arange(scene.amplitudes.shape[1]) % 3 == 0)
    for share in (0.1, 0.3, 1.5):
        level = np.where(np.arange(scene.shape[0]) < 100, share * 6.4, 6.4)[:, None]
        own = replace(
            scene, amplitudes=np.where(absent, 0, scene.amplitudes), background=np.broadcast_to(level, scene.shape)
        )
        yield Trial(f"vacuum {share} of the crystal", own, own.counts(), columns={"spacing_px": 40.0})
        yield Trial(f"vacuum {share} of the crystal, spacing not given", own, own.counts())
        strong = replace(own, amplitudes=own.amplitudes / 0.3)
        yield Trial(f"vacuum {share} of the crystal, contrast 1", strong, strong.counts())


def black_border() -> Iterator[Trial]:
    """A stack that was aligned before: black at the sides, where there is no noise. Right: scores as of `plain`."""
    scene, _ = crystal(step=0.0)
    counts = scene.counts()
    counts[:, :, :50] = counts[:, :, -50:] = 0
    yield Trial("black for 50 px at both sides", scene, counts, border=75.0)


def few_electrons() -> Iterator[Trial]:
    """Doses of 20 to 125 e/A^2, at low and at high contrast."""
    for dose in (20, 60, 125):
        for contrast in (0.45, 1.5):
            scene, _ = crystal(background=dose * 0.0064, contrast=contrast, step=0.2)
            yield Trial(f"{dose} e/A^2, contrast {contrast}", scene, scene.counts())


def dark_columns() -> Iterator[Trial]:
    """Columns that are darker than their surroundings, with the defaults. Right: scores as of `plain`."""
    for contrast in (0.3, 0.45, 0.68):
        scene, _ = crystal(background=12.8, contrast=-contrast)
        yield Trial(f"dark, contrast {contrast}", scene, scene.counts())
    scene, _ = crystal(background=12.8, contrast=-0.45)
    step = np.where(np.arange(scene.shape[0]) < 60, 2.0, 1.0)[:, None] * 12.8
    own = replace(scene, background=np.broadcast_to(step, scene.shape))
    yield Trial("dark, beside a bright vacuum", own, own.counts())


def lost_frames() -> Iterator[Trial]:
    """The crystal is away for some frames, or out of focus. Right: no fit of these frames is accepted."""
    scene, _ = crystal(background=6.4)
    away = np.zeros(len(scene.places), bool)
    away[[6, *range(14, 19)]] = True
    gone = replace(scene, amplitudes=np.where(away[:, None], 0, scene.amplitudes))
    yield Trial("crystal away in 6 frames", gone, gone.counts())
    wide = replace(scene, sigma=14.0, amplitudes=scene.amplitudes * (scene.sigma / 14) ** 2)
    blurred = replace(gone, places=scene.places)
    counts = np.where(away[:, None, None], wide.counts(), scene.counts())
    yield Trial("out of focus in 6 frames", blurred, counts)


def without_numbers() -> Iterator[Trial]:
    """Pixels that are NaN: one, a line, a border. Right: only fits whose windows hold them suffer."""
    scene, _ = crystal()
    for name, where in (
        ("one pixel", (slice(None), 200, 180)),
        ("a line", (slice(None), 200)),
        ("a border of 30 px", (slice(None), slice(None), slice(0, 30))),
    ):
        counts = scene.counts().astype("f4")
        counts[where] = np.nan
        yield Trial(f"NaN in {name}", scene, counts)


def gain_patterns() -> Iterator[Trial]:
    """Every pixel has a gain that stays. Right: errors and pulls as of the same dose without."""
    scene, _ = crystal(background=32.0)
    for share in (0.05, 0.1):
        pattern = 1 + np.random.default_rng(8).normal(0, share, scene.shape)
        own = replace(scene, background=32.0)
        yield Trial(f"gain pattern of {share:.0%}", own, _patterned(own, pattern))


def samplings() -> Iterator[Trial]:
    """Columns of 12 to 80 px apart, and narrow ones. Right: pull 1, errors near the bound."""
    for spacing in (12.0, 20.0, 40.0, 80.0):
        side = int(7 * spacing)
        sites = lattice((side, side), spacing)
        places = sites + np.random.default_rng(int(spacing)).normal(0, 0.2, (24, *sites.shape))
        scene = Scene(places, np.full(places.shape[:2], 30.0), 0.15 * spacing, 10.0, (side, side))
        yield Trial(f"spacing {spacing:g} px", scene, scene.counts(), border=spacing, tolerance=spacing / 5)
    for sigma in (0.8, 1.2):
        scene, _ = crystal(shape=(160, 160), spacing=8 * sigma, sigma=sigma, background=50.0, top=40.0, step=0.1)
        yield Trial(f"sigma {sigma} px", scene, scene.counts(), border=8.0, tolerance=8 * sigma / 5)


def two_grains() -> Iterator[Trial]:
    """Two crystals side by side, turned against each other, of one or two spacings. Right: all columns of both."""
    shape, half = (320, 360), 180.0
    for turned, other in ((20.0, 40.0), (20.0, 34.0), (30.0, 34.0)):
        left = lattice(shape, 40.0)
        left = left[left[:, 0] < half]
        right = lattice(shape, other, angle_deg=4.0 + turned)
        right = right[(right[:, 0] >= half) & (np.asarray(cKDTree(left).query(right)[0]) > 24)]
        places = np.concatenate([left, right]) + walk(40, 0.35, np.random.default_rng(9))[:, None]
        scene = Scene(places, np.full(places.shape[:2], 0.45 * 6.4), 5.0, 6.4, shape)
        yield Trial(f"two grains, turned by {turned:g} degrees, {other:g} px", scene, scene.counts())


def high_contrast() -> Iterator[Trial]:
    """Columns four times as bright as the vacuum, and nothing but vacuum."""
    scene, _ = crystal(contrast=4.0)
    for fit in ({}, {"estimator": "poisson"}):
        yield Trial(f"contrast 4 {fit}", scene, scene.counts(), fit)
    empty = replace(scene, amplitudes=np.zeros_like(scene.amplitudes))
    yield Trial("noise alone", empty, empty.counts())


def _patterned(scene: Scene, pattern: Floats) -> NDArray[Any]:
    return np.random.default_rng(11).poisson(scene.expected * pattern).astype("u2")


SCENES: dict[str, Callable[[], Iterator[Trial]]] = {
    make.__name__: make
    for make in (
        plain,
        pairs,
        hot_pixels,
        wedge,
        cameras,
        fields_that_turn,
        hops,
        vacuum_that_is_darker,
        black_border,
        few_electrons,
        dark_columns,
        lost_frames,
        without_numbers,
        gain_patterns,
        samplings,
        two_grains,
        high_contrast,
    )
}


def _moved(name: str, scene: Scene, places: Floats, drift: Floats) -> Trial:
    own = replace(scene, places=places + drift[:, None])
    return Trial(name, own, own.counts())


def run(trial: Trial) -> str:
    """Track a movie, and return its line."""
    with work_folder() as folder:
        tracks, _ = track(trial.counts, folder, trial.fit, trial.columns)
        found = score(tracks, trial.scene, border=trial.border, tolerance=trial.tolerance, unit=trial.unit)
        jumps = change_points(tracks, 0.99)
    background = float(np.mean(trial.scene.background))
    least = bound(float(np.median(trial.scene.amplitudes.max(axis=0))), trial.scene.sigma, background, WINDOW)[0]
    jumped = np.unique(jumps["column_id"].to_numpy()).size
    return f"{trial.name}: {found}; bound {least:.3f} px; columns with jumps {jumped}"


def main() -> None:
    """Print a line for each movie of the scenes that are named, or of all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*", choices=[[], *SCENES], metavar="NAME", help=", ".join(SCENES))
    for name in parser.parse_args().names or SCENES:
        for trial in SCENES[name]():
            print(run(trial), flush=True)


if __name__ == "__main__":
    main()
