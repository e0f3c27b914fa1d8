"""Atomap: its refinement by a rotated two-dimensional Gaussian, which masks a circle around each column.

Where the Gaussian fails it takes the centre of mass, and sets the amplitude to zero: that does not count as fine.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable

import numpy as np
from atomap.atom_position import Atom_Position

from benchmarks.peers.protocol import Found, Task, mosaic, serve


def prepare(task: Task) -> Callable[[], Found]:
    image, middles = mosaic(task)
    radius, (sigma_a, sigma_b) = task.windows.shape[1] // 2, task.start[0, 3:5]

    def work() -> Found:
        centres, fine = np.empty((len(middles), 2)), np.empty(len(middles), np.bool_)
        for number, (y, x) in enumerate(middles):
            atom = Atom_Position(x, y, sigma_a, sigma_b)
            atom.refine_position_using_2d_gaussian(image, rotation_enabled=True, mask_radius=radius)
            centres[number], fine[number] = (atom.pixel_x - x, atom.pixel_y - y), atom.amplitude_gaussian != 0
        return Found(centres + (task.windows.shape[1] - 1) / 2, fine)

    return work


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    logging.getLogger("hyperspy").setLevel(logging.ERROR)
    serve({"2d gaussian": prepare})
