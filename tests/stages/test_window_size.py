"""The size of the windows: given or derived, and refused where it cannot be used."""

from __future__ import annotations

import pytest

from tract_dask.errors import SettingsError
from tract_dask.stages.columns.window_size import resolve_window


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
