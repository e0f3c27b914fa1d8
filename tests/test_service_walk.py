"""The service as a new user meets it: every page in a browser, and what is downloaded at the end against the truth."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tract_dask.simulate import simulate_movie

WALK = Path(__file__).parents[1] / "scripts" / "service_walk"


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
        [sys.executable, WALK, tmp_path / "movie.tif", tmp_path / "walk"], capture_output=True, text=True, timeout=540
    )
    assert walked.returncode == 0, walked.stdout + walked.stderr
    assert "below 3.5 pm" in walked.stdout  # it did compare with the truth
