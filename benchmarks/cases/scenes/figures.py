"""The figures of docs/trust.md: ``python -m benchmarks.cases.scenes.figures docs/images``."""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

import tract_dask as td
from tract_dask.settings import ColumnSettings
from tract_dask.store.columns import positions
from tract_dask.store.schema import REJECTED

from ..common import track, work_folder
from .scenes import dark_columns, lost_frames

FRAMES = 24
SIZE = (8.0, 3.4)


def contrast(place: Path) -> None:
    """Draw dark columns in the summed image, as found by the default and where bright ones are asked for."""
    trial = list(dark_columns())[1].cut(FRAMES)
    with work_folder() as folder:
        _, movie = track(trial.counts, folder, {}, {})
        summed = td.sum_image(movie, td.estimate_drift(movie))
    figure = Figure(SIZE, layout="constrained")
    for axes, asked in zip(figure.subplots(1, 2), ("auto", "bright"), strict=True):
        found = td.find_columns(summed, ColumnSettings(contrast=asked))
        flagged = found["status_ref"].to_numpy() > 0
        axes.imshow(summed["image"], cmap="gray")
        for some, colour, what in (
            (~flagged, "tab:cyan", "not flagged"),
            (flagged, "tab:red", "flagged"),
        ):
            axes.plot(*positions(found)[some].T, "o", mfc="none", color=colour, ms=6, label=f"{what}: {some.sum()}")
        axes.set_title(f"contrast = {asked}: {found.attrs['contrast']}", fontsize=9)
        axes.legend(fontsize=7, loc="upper right")
        axes.set_axis_off()
    figure.savefig(place / "trust_contrast.png", dpi=130)


def lost(place: Path) -> None:
    """Draw quality, drift and accepted fits of a movie whose crystal is away for some frames."""
    trial = next(iter(lost_frames())).cut(FRAMES)
    with work_folder() as folder:
        tracks, movie = track(trial.counts, folder, {}, {})
        quality = td.estimate_drift(movie)["quality"].to_numpy()
    drift = tracks["drift"].sel(axis="x").to_numpy()
    true = np.median(trial.scene.places - trial.scene.places[0], axis=1)[:, 0]
    held = quality == 0
    share = ((tracks["status"].to_numpy() & int(REJECTED)) == 0).mean(axis=1)
    figure = Figure(SIZE, layout="constrained")
    left, right = figure.subplots(1, 2)
    frames = np.arange(len(drift))
    left.plot(frames, true - np.median(true[~held]), color="0.7", lw=3, label="truth")
    left.plot(frames, drift - np.median(drift[~held]), "k.", label="measured")
    left.plot(frames[held], (drift - np.median(drift[~held]))[held], "r.", label="interpolated")
    left.set(xlabel="frame", ylabel="drift along x, px")
    left.legend(fontsize=7)
    right.plot(frames, share, "k.-", label="share of accepted fits")
    right.plot(frames, quality, ".-", color="tab:blue", label="quality of the drift")
    right.set(xlabel="frame", ylim=(-0.05, 1.05))
    right.legend(fontsize=7)
    figure.savefig(place / "trust_lost_frames.png", dpi=130)


def main() -> None:
    """Draw all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    mpl.use("Agg")
    contrast(folder)
    lost(folder)


if __name__ == "__main__":
    main()
