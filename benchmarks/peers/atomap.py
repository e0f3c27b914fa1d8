"""Atomap: its refinement by a rotated two-dimensional Gaussian, which masks a circle around each column.

Where the Gaussian fails it takes the centre of mass, and sets the amplitude to zero: that does not count as fine.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable

import numpy as np
from atomap.atom_finding_refining import fit_atom_positions_gaussian
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


def pairs(task: Task) -> Callable[[], Found]:
    """Return both members' Gaussians, fitted at the same time; their shapes are free, as always there."""
    image, middles = mosaic(task)
    side = task.windows.shape[1]

    def work() -> Found:
        centres, fine = np.empty((len(middles), 2, 2)), np.empty(len(middles), np.bool_)
        for number, (middle, both) in enumerate(zip(middles, task.start, strict=False)):
            corner = middle[::-1] - (side - 1) / 2
            atoms = [Atom_Position(*(corner + one[1:3]), *one[3:5]) for one in both]
            found = fit_atom_positions_gaussian(atoms, image, rotation_enabled=True, mask_radius=side // 3)
            fine[number] = found is not False and all(fit is not False for fit in np.atleast_1d(found))
            if fine[number]:
                centres[number] = [np.array([fit.centre_x.value, fit.centre_y.value]) - corner for fit in found]
            else:
                centres[number] = both[:, 1:3]
        return Found(centres, fine)

    return work


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    logging.getLogger("hyperspy").setLevel(logging.ERROR)
    serve({"2d gaussian": prepare, "pairs": pairs})
