"""Are the errors that fits state true? By the distance of columns, and by the window.

``python -m benchmarks.cases.scenes.stated_errors``. Right: a pull of 1, and a ratio of stated to true error of 1,
whatever the spacing and the window.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy.ndimage import gaussian_filter

from tract_dask.kernels.gaussian.fit import fit_gaussians

from ..common import Scene, lattice, score, track, work_folder

BLUR_PX = 2.0
MARGIN = 10
"""Pixels around a window that are blurred into it, and then cut off."""


def by_spacing(spacing: float) -> str:
    """Track columns that jitter by 0.2 px by themselves, 7 by 7 of them."""
    side = int(7 * spacing)
    sites = lattice((side, side), spacing)
    jitter = np.random.default_rng(int(spacing)).normal(0, 0.2, (24, *sites.shape))
    scene = Scene(sites + jitter, np.full(jitter.shape[:2], 30.0), 0.15 * spacing, 10.0, (side, side))
    with work_folder() as folder:
        tracks, _ = track(scene.counts(), folder, {}, {})
        return f"spacing {spacing:g} px, window {tracks.attrs['window_px']}: {score(tracks, scene, border=spacing)}"


def by_window(window: int, fits: int, sigma: float = 5.0, amplitude: float = 5.76, background: float = 12.8) -> str:
    """Fit one column many times, each with other counts, and compare the scatter with the stated errors."""
    side = window + 2 * MARGIN
    axis = np.arange(side) - side // 2
    model = amplitude * np.exp(-(axis[:, None] ** 2 + axis**2) / (2 * sigma**2)) + background
    counts = np.random.default_rng(0).poisson(model, (fits, side, side)).astype(np.float32)
    blurred = np.stack([gaussian_filter(image, BLUR_PX) for image in counts])[:, MARGIN:-MARGIN, MARGIN:-MARGIN]
    wide = np.hypot(sigma, BLUR_PX)
    start = np.array([amplitude * (sigma / wide) ** 2, window // 2, window // 2, wide, wide, 0.0, background])
    reach = np.array([5 * amplitude, window / 4, window / 4, 30.0, 30.0, np.pi, 100.0])
    low, high = start - reach, start + reach
    low[[0, 3, 4]] = 0.0, 0.5, 0.5
    found = fit_gaussians(
        np.ascontiguousarray(blurred), start, low, high, fixed_shape=True, blur_sigma_px=BLUR_PX, radius_px=window / 2
    )
    good = found.converged & ~found.at_bound
    ratios = found.stderr[good][:, [1, 0, 6]].mean(axis=0) / found.estimates[good][:, [1, 0, 6]].std(axis=0)
    x, height, level = ratios
    parts = f"x {x:.2f}, height {height:.2f}, background {level:.2f}"
    return f"window {window}: stated / true error of {parts}; {good.mean():.1%} good"


def main() -> None:
    """Print a line for each spacing and each window."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--spacing", type=float, nargs="*", default=[14.0, 20.0, 30.0, 40.0])
    parser.add_argument("--window", type=int, nargs="*", default=[13, 17, 21, 25, 31, 41])
    parser.add_argument("--fits", type=int, default=3000)
    options = parser.parse_args()
    for spacing in options.spacing:
        print(by_spacing(spacing), flush=True)
    for window in options.window:
        print(by_window(window, options.fits), flush=True)


if __name__ == "__main__":
    main()
