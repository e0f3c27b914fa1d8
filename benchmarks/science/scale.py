"""Every analysis on 20,000 frames x 400 columns: time and memory, each in a process of its own."""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

import tract_dask as td
from tract_dask.settings import FitSettings, to_toml
from tract_dask.simulate.shipped import ceo2_table
from tract_dask.stages.fit import join
from tract_dask.store import parts, results, schema
from tract_dask.store.journal import Journal, journal_beside
from tract_dask.store.shards import Shard, split

from .tables import Table

N_FRAMES, N_COLUMNS, FRAMES_PER_SHARD = 20_000, 400, 16
"""16 frames a shard are what 2048 x 2048 pixels of uint16 have."""
_DOSE, _PIXEL_PM, _FRAME_TIME_S = 500.0, 4.0, 0.01
_SPACING_PX = 86.0
_ERROR_PX, _LOST = 1.2, 0.02
_JUMPERS, _JUMPS = 10, 6
_ATOMS = 3


def _analyses(path: Path) -> dict[str, Callable[[xr.Dataset], object]]:
    """Return what is measured: a name as users call it, and the call, all of whose result is computed."""
    from tract_dask.analysis import intensity, jumps, mixtures, motion, occupancy, precision, presence
    from tract_dask.export import tables

    vacuum = _DOSE * (_PIXEL_PM / 100) ** 2
    file = path.with_name("export")
    window = dict.fromkeys(("atoms", "low_68", "high_68", "low_95", "high_95", "ambiguous"))

    def few_jumps(tracks: xr.Dataset) -> xr.Dataset:
        return xr.Dataset({"column_id": ("jump", tracks["column_id"].to_numpy()[:3])})

    def counted(tracks: xr.Dataset, frames: str) -> xr.Dataset:
        return occupancy.count_atoms(tracks, ceo2_table(), vacuum, frames=frames, max_atoms=6)[list(window)].compute()

    return {
        "`accepted`, mean of a variable": lambda t: td.accepted(t)["intensity"].mean().compute(),
        "`motion.spread`": lambda t: motion.spread(t).compute(),
        "`motion.displacement`": lambda t: motion.displacement(t, 10, 15_000).compute(),
        "`motion.lattice_displacement`, sd of it": lambda t: (
            motion.lattice_displacement(t)["displacement"].std("frame").compute()
        ),
        "`jumps.threshold_jumps`": lambda t: jumps.threshold_jumps(t, 30.0),
        "`jumps.change_points`": lambda t: jumps.change_points(t),
        "`jumps.jump_rate`, `activation_energy`": lambda t: jumps.activation_energy(
            jumps.jump_rate(few_jumps(t), t), 300.0
        ).compute(),
        "`presence.present`, share of it": lambda t: presence.present(t).mean().compute(),
        "`presence.appearances`": lambda t: presence.appearances(t),
        "`precision.precision_table`": lambda t: precision.precision_table(t),
        "`intensity.normalised`, `repeated_error`": lambda t: intensity.repeated_error(
            intensity.normalised(t, vacuum)
        ).compute(),
        "`intensity.mean_intensity`, 100 frames": lambda t: intensity.mean_intensity(t, 100).compute(),
        "`intensity.with_scale`, mean of it": lambda t: (
            intensity.with_scale(t, "ellipse")[["intensity", "intensity_error"]].mean().compute()
        ),
        "`occupancy.count_atoms`, each frame": lambda t: counted(t, "each"),
        "`occupancy.count_atoms`, mean": lambda t: counted(t, "mean"),
        "`mixtures.mixture`": lambda t: mixtures.mixture(
            intensity.mean_intensity(t)["intensity"].isel(frame=0, drop=True).compute()
        ),
        "`export` .csv": lambda t: tables.export(t, file.with_suffix(".csv"), overwrite=True),
        "`export` .parquet": lambda t: tables.export(t, file.with_suffix(".parquet"), overwrite=True),
        "`export` .nc": lambda t: tables.export(t, file.with_suffix(".nc"), overwrite=True),
        "`export` .mat": lambda t: tables.export(t, file.with_suffix(".mat"), overwrite=True),
    }


def run(_data: Path, work: Path) -> list[Table]:
    """Measure every analysis, on tracks that are made up in ``work``."""
    path = work / "results.zarr"
    make(path)
    return [table(path, [measure(path, name) for name in _analyses(path)])]


def measure(path: Path, name: str, before: Sequence[str] = ()) -> list[str]:
    """Return the row of an analysis, from a process of its own; ``before`` goes in front of its command."""
    command = [*before, sys.executable, "-m", "benchmarks.science.scale", str(path), name]
    found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()[-1])
    return [
        name,
        *(f"{found[key]:.1f}" for key in ("seconds", "cpu")),
        *(f"{found[key]:.0f}" for key in ("peak", "before")),
    ]


def table(path: Path, rows: list[list[str]]) -> Table:
    """Return the table of analyses."""
    size = sum(file.stat().st_size for file in path.rglob("*") if file.is_file())
    return Table(
        f"{N_FRAMES:,} frames x {N_COLUMNS} columns, {size / 1e9:.1f} GB on disk, each in a separate process.",
        ["analysis", "s", "s of CPU", "peak memory, MB", "of it before it began, MB"],
        rows,
    )


def make(path: Path) -> None:
    """Write tracks of columns of 3 atoms, of which every tenth jumps six times; two in a hundred fits are lost."""
    rng = np.random.default_rng(0)
    columns = _columns()
    ids = columns["column_id"].to_numpy()
    table = ceo2_table()
    results.create(
        path,
        columns,
        np.zeros((N_FRAMES, 2)),
        np.arange(N_FRAMES) * _FRAME_TIME_S,
        FRAMES_PER_SHARD,
        pixel_size_pm=_PIXEL_PM,
        frame_time_s=_FRAME_TIME_S,
        dose=_DOSE,
        settings=to_toml(FitSettings(blur_sigma_px=2.0)),
        window=round(table.attrs["window_pm"] / _PIXEL_PM),
        reference_blur_px=2.0,
    )
    jumps = {int(c): np.sort(rng.integers(1, N_FRAMES, _JUMPS)) for c in range(0, len(ids), _JUMPERS)}
    steps = {c: np.cumsum(rng.normal(0.0, 2.0, (_JUMPS + 1, 2)), axis=0) for c in jumps}
    level = float(table["intensity"].sel(atoms=_ATOMS)) * _DOSE
    journal = Journal(journal_beside(path), "scale")
    for shard in split(N_FRAMES, FRAMES_PER_SHARD):
        values = _values(shard, columns, level, rng)
        frames = np.arange(shard.start, shard.stop)
        for c, at in jumps.items():
            values["fit"][:, c, 1:3] += steps[c][np.searchsorted(at, frames, side="right")]
        values["centroid"][:] = values["fit"][..., [2, 1]]
        with journal.batch() as done:
            parts.write(journal.path, shard, values, FRAMES_PER_SHARD)
            done(shard, {})
    join.join(path, journal)
    results.finish(path)
    journal.remove()


def _columns() -> xr.Dataset:
    side = int(np.ceil(np.sqrt(N_COLUMNS)))
    row, column = np.divmod(np.arange(N_COLUMNS), side)
    x, y = _SPACING_PX * (1 + column + 0.5 * (row % 2)), _SPACING_PX * 0.9 * (1 + row)
    fit = np.tile([0.4 * _DOSE * (_PIXEL_PM / 100) ** 2, 0.0, 0.0, 12.0, 11.0, 0.3, 0.8], (N_COLUMNS, 1))
    fit[:, 1], fit[:, 2] = x, y
    return xr.Dataset(
        {
            "x_ref": ("column_id", x),
            "y_ref": ("column_id", y),
            "kind": ("column_id", schema.texts(["Ce"] * N_COLUMNS)),
            "fit_ref": (("column_id", "parameter"), fit),
            "status_ref": ("column_id", np.zeros(N_COLUMNS, np.uint8)),
        },
        {"column_id": np.arange(1, N_COLUMNS + 1)},
    )


def _values(
    shard: Shard, columns: xr.Dataset, level: float, rng: np.random.Generator
) -> dict[str, np.ndarray[Any, Any]]:
    """Return the variables of a shard: columns that keep still, with normal noise."""
    sizes = schema.SIZES | {"frame": shard.frames, "column_id": N_COLUMNS}
    values: dict[str, np.ndarray[Any, Any]] = {
        name: np.zeros([sizes[dim] for dim in variable.dims], variable.dtype)
        for name, variable in schema.RESULTS.items()
        if name not in ("drift_measured", "time")
    }
    values["fit"][:] = columns["fit_ref"].to_numpy()
    values["fit"][..., 1:3] += rng.normal(0.0, _ERROR_PX, (shard.frames, N_COLUMNS, 2))
    values["stderr"][:] = _ERROR_PX
    values["intensity"][:] = rng.normal(level, 0.1 * level, (shard.frames, N_COLUMNS))
    values["intensity_error"][:] = values["intensity_stderr"][:] = 0.1 * level
    values["status"][rng.random((shard.frames, N_COLUMNS)) < _LOST] = schema.Status.BELOW_NOISE
    values["noise"][:] = 0.05
    values["presence"][:] = rng.normal(10.0, 1.0, (shard.frames, N_COLUMNS))
    values["presence_vacuum"][:] = rng.normal(0.0, 1.0, values["presence_vacuum"].shape)
    return values


def main() -> None:
    """Run one analysis, and print its seconds and memory as JSON."""
    parser = argparse.ArgumentParser()
    parser.add_argument("results", type=Path)
    parser.add_argument("analysis")
    options = parser.parse_args()
    analysis = _analyses(options.results)[options.analysis]
    tracks = td.open_results(options.results)
    before = _peak_mb()
    start, start_cpu = time.perf_counter(), time.process_time()
    analysis(tracks)
    seconds, cpu = time.perf_counter() - start, time.process_time() - start_cpu
    print(json.dumps({"seconds": seconds, "cpu": cpu, "peak": _peak_mb(), "before": before}))


def _peak_mb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()
