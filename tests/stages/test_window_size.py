"""The size of the windows and of the blur: given or derived, and refused where they cannot be used."""

from __future__ import annotations

import numpy as np
import pytest

from tract_dask.errors import SettingsError
from tract_dask.stages.columns.window_size import resolve_blur, resolve_window
from tract_dask.store.columns import column_dataset


@pytest.mark.parametrize(
    ("given", "spacing", "expected"), [(25, None, 25), (25, 82.8, 25), (None, 82.8, 43), (None, 3.0, 7)]
)
def test_what_is_given_comes_before_what_suits_the_spacing(given, spacing, expected):
    assert resolve_window(given, (100, 60), spacing) == expected


@pytest.mark.parametrize(
    ("given", "spacing", "message"),
    [
        (24, 82.8, "odd number from 5 to 60.*24"),
        (3, None, "odd number from 5 to 60.*3"),
        (61, None, "odd number from 5 to 60.*61"),
        (None, 200.0, "101, from a spacing of 200 px"),
        (None, None, "one column alone"),
    ],
)
def test_windows_that_cannot_be_used_are_refused(given, spacing, message):
    with pytest.raises(SettingsError, match=message):
        resolve_window(given, (100, 60), spacing)


@pytest.mark.parametrize(
    ("given", "about", "expected"),
    [
        (1.7, {"sigma_px": 5.0}, 1.7),
        (0.0, {"sigma_px": 5.0}, 0.0),
        (None, {"sigma_px": 1.2}, 0.5),
        (None, {"blur_sigma_px": 3.0}, 2.0),  # fits 5 px wide after a blur of 3 px: columns of 4 px
        (None, {}, 2.0),
    ],
)
def test_the_blur_is_what_is_given_or_follows_the_columns(given, about, expected):
    columns = column_dataset(np.zeros((3, 2)), fit=np.tile([1.0, 0, 0, 5, 5, 0, 1], (3, 1))).assign_attrs(about)
    assert resolve_blur(given, columns) == expected


def test_columns_without_fits_have_the_blur_of_the_paper():
    assert resolve_blur(None, column_dataset(np.zeros((3, 2)))) == 2.0
