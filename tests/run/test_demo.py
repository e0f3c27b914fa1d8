"""The demonstration: its comparison with the truth, and the whole of it on a short movie."""

import numpy as np
import pytest
import xarray as xr

from tract_dask.kernels.gaussian.parameters import PARAMETERS
from tract_dask.progress import RunStarted
from tract_dask.run.demo import compare, run_demo
from tract_dask.settings import ClusterSettings, RunSettings
from tract_dask.simulate.movie import simulate_movie
from tract_dask.store.schema import AXES, RESULTS, Status

POSITION_PM = 4.5
"""Budget of the position error per axis at 500 e/A^2 and half contrast; found: 3.2."""

DRIFT_PM = 0.8
"""Budget of the drift's error per axis; found: 0.3."""


def results_from(truth: xr.Dataset, error_px: np.ndarray, offset_px: float) -> xr.Dataset:
    """Results of a fit that makes the given errors (frame, column), and whose drift has another zero than the truth."""
    cerium = truth.isel(column_id=np.flatnonzero(truth["kind"] == "Ce"))
    drift = truth["drift"].to_numpy() - offset_px
    fit = np.zeros((truth.sizes["frame"], cerium.sizes["column_id"], len(PARAMETERS)))
    for name, k in (("x", 1), ("y", 0)):
        fit[..., PARAMETERS.index(name)] = cerium[name].to_numpy() - drift[:, k, None] + error_px
    gone = cerium["atoms"].to_numpy() == 0
    per_column = {
        name: (RESULTS[name].dims, np.ones(fit.shape[:2]))
        for name in ("intensity", "intensity_error", "intensity_stderr")
    }
    return xr.Dataset(
        per_column
        | {
            "fit": (RESULTS["fit"].dims, fit),
            "stderr": (RESULTS["stderr"].dims, np.ones_like(fit)),
            "drift": (("frame", "axis"), drift),
            "status": (RESULTS["status"].dims, np.where(gone, int(Status.BELOW_NOISE), 0).astype(np.uint16)),
            "x_ref": ("column_id", cerium["x"].to_numpy()[0] + offset_px),
            "y_ref": ("column_id", cerium["y"].to_numpy()[0] + offset_px),
        },
        coords={"parameter": list(PARAMETERS), "axis": list(AXES)},
    )


def test_comparison_finds_the_errors_that_were_made(tmp_path):
    truth = simulate_movie(tmp_path / "m.tif", n_frames=40, shape=(256, 256))
    n_columns = int((truth["kind"] == "Ce").sum())
    error = np.random.default_rng(0).normal(0, 0.5, (40, n_columns))
    found = compare(results_from(truth, error, offset_px=1.7), truth)
    assert found["position error x, pm"] == pytest.approx(0.5 * 8, rel=0.1)
    assert found["position error y, pm"] == found["position error x, pm"]
    assert found["drift error x, pm"] == found["drift error y, pm"] == 0
    assert found["oxygen taken for cerium"] == 0
    assert found["absences noticed"] == "9 of 9 frames"
    assert found["cerium columns found"].split()[0] == found["cerium columns found"].split()[-1]


@pytest.mark.slow
def test_the_demonstration_keeps_its_budgets(tmp_path):
    events = []
    settings = RunSettings(cluster=ClusterSettings(workers=1, memory_limit="2GB"))
    table = run_demo(tmp_path, 20, settings, on_event=events.append)
    assert table["frames"] == 20
    assert table["accepted"] > 0.97 * table["fits"]
    found, _, wanted = table["cerium columns found"].split()
    assert found == wanted
    assert table["oxygen taken for cerium"] == 0
    assert max(table["position error x, pm"], table["position error y, pm"]) < POSITION_PM
    assert max(table["drift error x, pm"], table["drift error y, pm"]) < DRIFT_PM
    assert table["dashboard"] in {event.dashboard for event in events if isinstance(event, RunStarted)}
    assert (tmp_path / "out" / "columns.png").stat().st_size > 10_000
