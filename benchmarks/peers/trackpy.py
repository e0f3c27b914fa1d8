"""Trackpy: refine_leastsq fits a round Gaussian and a background; refine_com is a centroid, and no fit at all."""

from __future__ import annotations

import warnings
from collections.abc import Callable

import numpy as np
import pandas as pd
import trackpy
from trackpy.refine.center_of_mass import refine_com_arr

from benchmarks.peers.protocol import Found, Task, mosaic, serve

MAX_SHIFT_PX = 3


def least_squares(task: Task) -> Callable[[], Found]:
    image, middles = mosaic(task)
    side = task.windows.shape[1]
    amplitude, sigma, background = task.start[:, 0].mean(), task.start[:, 3:5].mean(), task.start[:, 6].mean()
    guess = {"signal": amplitude, "size": sigma * np.sqrt(2), "background": background}
    places = pd.DataFrame({"y": middles[:, 0], "x": middles[:, 1]})

    def work() -> Found:
        fits = trackpy.refine_leastsq(
            places.copy(),
            image,
            diameter=side - 2,
            separation=side,
            fit_function="gauss",
            param_mode=dict.fromkeys(guess, "var"),
            param_val=guess,
            max_shift=MAX_SHIFT_PX,
        )
        centres = fits[["x", "y"]].to_numpy() - middles[:, ::-1] + (side - 1) / 2
        return Found(centres, np.isfinite(fits["cost"].to_numpy()))

    return work


def centroid(task: Task) -> Callable[[], Found]:
    image, middles = mosaic(task)
    half = task.windows.shape[1] // 2
    bright = np.pad(np.clip(image - np.median(image), 0, None), half)
    places = middles + half

    def work() -> Found:
        rows = refine_com_arr(
            bright, bright, (half, half), places, max_iterations=10, engine="numba", characterize=False
        )
        centres = (rows[:, :2] - places)[:, ::-1] + half
        return Found(centres, np.ones(len(centres), np.bool_))

    return work


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    trackpy.quiet()
    serve({"leastsq": least_squares, "centroid": centroid})
