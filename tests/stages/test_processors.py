"""Kinds of processors: recorded where numbers are kept, said where they differ, and how much results differ by."""

from __future__ import annotations

import json
import os
import subprocess
import sys

import numpy as np
import pytest
import xarray as xr
from conftest import Scene

from tract_dask import convert, open_movie
from tract_dask.progress import Warned
from tract_dask.settings import ConvertSettings, FitSettings
from tract_dask.stages.drift.stage import estimate_drift
from tract_dask.stages.fit import job as fit_job
from tract_dask.stages.fit import stage as fit
from tract_dask.store import metadata
from tract_dask.store.provenance import processor

SAME_PX = 1e-3
"""Positions; a hundredth of their errors."""
SAME_SHARE = 5e-3
"""Noise, intensities and their errors."""
SAME_FITS = 0.99
"""Share of the fits with the same flags: a fit at the edge of a flag may fall on either side."""

PROCESSORS = {4: ("generic", ""), 8: ("haswell", "+avx,+avx2,+fma"), 16: ("skylake-avx512", "+avx,+avx2,+fma,+avx512f")}

RUN = """
import sys
from tract_dask.run import pipeline
from tract_dask.settings import ConvertSettings, RunSettings
from distributed import Client, LocalCluster
with LocalCluster(processes=False, n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
    with Client(cluster) as client:
        settings = RunSettings(convert=ConvertSettings(shard_mb=1, tile_px=64))
        pipeline.run(sys.argv[1], sys.argv[2], settings, client=client, report=False)
"""


@pytest.fixture
def movie(npy, tmp_path):
    frames = Scene(n_frames=50).counts()
    settings = ConvertSettings(shard_mb=1, tile_px=32)
    return open_movie(convert(npy(frames), tmp_path / "movie.zarr", settings=settings))


def fit_into(movie, path):
    scene, events = Scene(n_frames=50), []
    job = fit_job.prepare(movie, scene.columns(), scene.drift_dataset(), FitSettings())
    fit.fit_movie(movie, job, path, on_event=events.append)
    return metadata.attributes(path), [event.message for event in events if isinstance(event, Warned)]


def test_stores_say_on_which_processors_their_numbers_were_computed(movie, tmp_path):
    about, warned = fit_into(movie, tmp_path / "results.zarr")
    assert about["processors"] == [about["processor"]] == [processor()]
    assert not warned
    assert metadata.attributes(movie.path)["processor"] == processor()
    assert estimate_drift(movie).attrs["processors"] == [processor()]


def test_processors_with_other_vectors_in_one_fit_are_said(movie, tmp_path, monkeypatch):
    kinds = iter(["haswell, 8 lanes", "znver4, 16 lanes"] * 8)
    monkeypatch.setattr(fit, "processor", lambda: next(kinds))
    about, warned = fit_into(movie, tmp_path / "results.zarr")
    assert about["processors"] == ["haswell, 8 lanes", "znver4, 16 lanes"]
    assert len(warned) == 1
    assert "vectors of 8 and 16 numbers" in warned[0]


def run_with(lanes: int, movie, out) -> xr.Dataset:
    """Run as a processor with that many lanes would; return the results."""
    environment, kind = dict(os.environ), processor()
    if lanes != lanes_here():
        name, features = PROCESSORS[lanes]
        environment |= {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": features}
        kind = f"{name}, {lanes} lanes"
    subprocess.run([sys.executable, "-c", RUN, movie, out], env=environment, check=True, capture_output=True)
    assert metadata.attributes(out / "results.zarr")["processors"] == [kind]
    return xr.open_zarr(out / "results.zarr", consolidated=False).load()


def lanes_here() -> int:
    return int(processor().split()[-2])


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_whole_runs_are_the_same_at_every_width(npy, tmp_path):
    movie = npy(Scene(n_frames=16, shape=(256, 256)).counts())
    widths = [lanes for lanes in PROCESSORS if lanes <= lanes_here()]
    first, *others = (run_with(lanes, movie, tmp_path / f"lanes-{lanes}") for lanes in widths)
    for other in others:
        same = (first["status"] == other["status"]).to_numpy()
        assert same.mean() >= SAME_FITS
        for name in ("x", "y"):
            one, two = (found["fit"].sel(parameter=name).to_numpy()[same] for found in (first, other))
            np.testing.assert_allclose(one, two, atol=SAME_PX)
        np.testing.assert_allclose(first["drift_measured"], other["drift_measured"], atol=SAME_PX)
        np.testing.assert_allclose(first["noise"], other["noise"], rtol=SAME_SHARE)
        for name in ("intensity", "intensity_stderr"):
            one, two = (found[name].to_numpy()[same] for found in (first, other))
            np.testing.assert_allclose(one, two, rtol=SAME_SHARE)


def test_a_processor_is_told_by_its_environment():
    code = "import json; from tract_dask.store.provenance import processor; print(json.dumps(processor()))"
    name, features = PROCESSORS[8]
    environment = os.environ | {"NUMBA_CPU_NAME": name, "NUMBA_CPU_FEATURES": features}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert json.loads(done.stdout) == "haswell, 8 lanes"
