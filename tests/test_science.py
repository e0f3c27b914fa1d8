"""The measurement of everything against known truth: its scores on known results, and its place in the documents."""

import re
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from benchmarks.science import jumps, occupancy, scale
from benchmarks.science.__main__ import DOCUMENT, SECTIONS
from benchmarks.science.tables import Table, markdown, markers, publish
from tract_dask import open_results
from tract_dask.analysis import motion


def test_every_section_has_its_tables_in_the_document():
    text = DOCUMENT.read_text(encoding="utf-8")
    for section in SECTIONS:
        begin, end = map(re.escape, markers(section))
        (block,) = re.findall(f"{begin}\n(.*?){end}", text, flags=re.DOTALL)
        assert block.count("| --- |") >= 1, section


def test_publishing_replaces_one_section(tmp_path):
    document = tmp_path / "page.md"
    places = "\n".join("\n".join(markers(name)) for name in ("a", "b"))
    document.write_text(f"before\n{places}\nafter\n")
    for value in ("1", "2"):
        publish("b", markdown([Table("Caption.", ["head"], [[value]])]), document)
    text = document.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "| 2 |" in text
    assert "| 1 |" not in text
    assert text.index(markers("b")[0]) < text.index("| 2 |")
    with pytest.raises(ValueError, match="no lines"):
        publish("c", "", document)


def test_jumps_are_counted_once_each():
    table = xr.Dataset({"column_id": ("jump", [4, 4, 4, 7, 7, 9]), "frame": ("jump", [6, 12, 30, 5, 8, 5])})
    cells = jumps._found(table, 4, still=[7, 8], true=[6, 11, 20])
    assert cells == ["2 of 3", "20", "1", "1 of 2", "2"]


def test_absences_count_only_frames_that_could_be_judged():
    absent = xr.DataArray([[True, True], [False, True], [True, False]], {"column_id": [1, 2]}, ("frame", "column_id"))
    seen = xr.full_like(absent, True)
    seen[0] = False
    cells = jumps._absences(absent & seen, seen, {16: 1}, {16: np.array([False, False, True])}, still=[2])
    assert cells == ["0 of 1", "1 of 1", "1 of 2 (50.0%)"]


def test_sets_hold_the_truth_as_often_as_they_claim():
    """Numbers drawn from the stated probabilities themselves: what a perfect count would report."""
    rng = np.random.default_rng(0)
    shares = rng.dirichlet(np.ones(5), size=(1, 4000)).astype(np.float32)
    drawn = [rng.choice(5, p=share / share.sum()) for share in shares[0].astype(float)]
    probability = xr.DataArray(shares, {"n_atoms": np.arange(5)}, ("frame", "column_id", "n_atoms"))
    holds, claims, size = occupancy._sets(probability, xr.DataArray(drawn, dims="column_id"), 0.68)
    assert holds.mean() == pytest.approx(claims.mean(), abs=3 * np.sqrt(0.2 / 4000))
    assert claims.min() >= 0.68 - 1e-6
    assert 1 <= size.min() <= size.max() <= 5


def test_the_tracks_of_scale_are_what_they_say(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(scale, "N_FRAMES", 200)
    monkeypatch.setattr(scale, "N_COLUMNS", 12)
    scale.make(tmp_path / "results.zarr")
    spread = motion.spread(open_results(tmp_path / "results.zarr")).compute()
    still = spread.isel(column_id=np.arange(12) % scale._JUMPERS != 0)
    np.testing.assert_allclose(still["sd"], scale._ERROR_PX * scale._PIXEL_PM, rtol=0.2)
    assert (spread["n"] > 180).all()
    assert int(spread["n"].sum()) < 12 * 200
