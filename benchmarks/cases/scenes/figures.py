"""The figures of docs/trust.md: ``python -m benchmarks.cases.scenes.figures docs/images``."""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from scipy.spatial import cKDTree

import tract_dask as td
from tract_dask.analysis.intensity import mean_intensity
from tract_dask.kernels.gaussian.intensity import INTENSITY_SCALE
from tract_dask.settings import ColumnSettings
from tract_dask.store.columns import positions
from tract_dask.store.schema import REJECTED

from ..common import track, work_folder
from .sampling import scene_of
from .scenes import dark_columns, lost_frames

FRAMES = 24
SIZE = (8.0, 3.4)
_ERRORS = "errors of the frames alone", "with the shape's"


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


def shapes(place: Path) -> None:
    """Draw mean intensities of equal columns, with errors of the means without that of the shape and with it."""
    scene, judged = scene_of(20.0, 3.0, seed=7)
    with work_folder() as folder:
        tracks, _ = track(scene.counts(7), folder, {}, {})
    drift = tracks["drift"].sel(axis=["x", "y"]).to_numpy()
    still = np.median(scene.places[:, judged] - drift[:, None], axis=0)
    which = cKDTree(positions(tracks)).query(still)[1]
    mean = mean_intensity(td.accepted(tracks).isel(column_id=np.sort(which))).isel(frame=0)
    true = INTENSITY_SCALE["paper"] * 2 * np.pi * scene.amplitudes[0, 0] * scene.sigma**2
    alone, both = mean["stderr"], np.hypot(mean["stderr"], mean["shape_stderr"])
    figure = Figure(SIZE, layout="constrained")
    for axes, error, name in zip(figure.subplots(1, 2, sharey=True), (alone, both), _ERRORS, strict=True):
        number = np.arange(1, mean.sizes["column_id"] + 1)
        axes.axhline(1, color="0.7", lw=3)
        axes.errorbar(number, mean["intensity"] / true, error / true, fmt="k.", ecolor="tab:blue", lw=1.5)
        pull = float(((mean["intensity"] - mean["intensity"].mean()) / error).std())
        axes.set_title(f"{name}: scatter / error = {pull:.1f}", fontsize=9)
        axes.set(xlabel="column")
    figure.axes[0].set(ylabel="mean intensity / true intensity")
    figure.savefig(place / "trust_shapes.png", dpi=130)


def main() -> None:
    """Draw all."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    mpl.use("Agg")
    contrast(folder)
    lost(folder)
    shapes(folder)


if __name__ == "__main__":
    main()
