"""Errors."""

from __future__ import annotations

import pickle

from tract_dask.errors import SourceError, TractError


def test_an_error_is_one_paragraph_and_crosses_processes():
    error = SourceError("page 3 has another shape", "movie.tif", "512 x 512", "512 x 500", "Export it again")
    text = "movie.tif: page 3 has another shape. Expected 512 x 512; got 512 x 500. Export it again."
    assert str(error) == text
    assert str(pickle.loads(pickle.dumps(error))) == text
    assert (TractError("x").exit_code, error.exit_code) == (1, 2)
