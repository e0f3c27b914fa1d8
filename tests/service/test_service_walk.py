"""The service from outside: as a new user meets it in a browser, and as many at once do."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tract_dask.simulate.movie import simulate_movie

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.mark.slow
def test_a_new_user_goes_from_a_movie_to_a_dataset(tmp_path):
    truth = simulate_movie(tmp_path / "movie.tif", n_frames=16, shape=(384, 384), dose=5000)
    np.savez(
        tmp_path / "movie_truth.npz",
        ids=truth["column_id"],
        xy=np.stack([truth["x"], truth["y"]], axis=-1),
        n_ce=truth["atoms"],
    )
    walked = subprocess.run(
        [sys.executable, SCRIPTS / "service_walk", tmp_path / "movie.tif", tmp_path / "walk", "--no-pictures"],
        capture_output=True,
        text=True,
        timeout=540,
    )
    assert walked.returncode == 0, walked.stdout + walked.stderr
    assert "below 3.5 pm" in walked.stdout  # it did compare with the truth


@pytest.mark.slow
def test_the_load_test_measures_a_service(tmp_path):
    options = ["--minutes", "0.2", "--jobs", "2", "--watchers", "2", "--rate", "8", "--folder", str(tmp_path)]
    loaded = subprocess.run(
        [sys.executable, SCRIPTS / "service_load_test", *options], capture_output=True, text=True, timeout=400
    )
    assert re.search(r"^all +\d+( +\d+\.\d){4}$", loaded.stdout, re.MULTILINE), loaded.stdout + loaded.stderr
    assert re.search(r"^events, on their way +[1-9]\d*( +\d+\.\d){4}$", loaded.stdout, re.MULTILINE), loaded.stdout
    assert "Traceback" not in loaded.stderr  # its exit code is of the times, which mean nothing here
