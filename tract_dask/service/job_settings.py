"""The settings of a job: as a user gives them, as a job keeps them, and with the paths that its run takes.

They are built once in the service, to be checked at submission. What is stored goes on as it is, to each process that
builds settings of its own from it.
"""

from __future__ import annotations

from typing import Any

from ..errors import SettingsError
from ..settings.run import RunSettings
from ..settings.toml import from_dict, to_dict
from .data_root import DataRoot

_FILES = (
    ("drift", "csv"),
    ("columns", "csv"),
    ("convert", "dark"),
    ("convert", "gain_reference"),
    ("convert", "defects"),
)
"""Group and name of the settings that are files."""


def stored_settings(values: dict[str, Any]) -> dict[str, Any]:
    """Return the settings that a user gives as a job keeps them: all of them, but for the cluster.

    Raises
    ------
    SettingsError
        Where one does not exist, is out of range, or is not a job's to decide.
    """
    if "cluster" in values:
        raise SettingsError(
            "a job cannot choose the cluster",
            "settings",
            f"groups {', '.join(name for name in values if name != 'cluster') or 'of the run'}",
            "cluster",
            "Leave it out; serve --cluster sets it",
        )
    found = to_dict(from_dict(RunSettings, values))
    del found["cluster"]
    return found


def inside(root: DataRoot, stored: dict[str, Any]) -> dict[str, Any]:
    """Return settings as a job keeps them, but with whole paths, each checked to lie under the data root.

    Raises
    ------
    OutsideError, MissingStoreError
        As :meth:`DataRoot.resolve`.
    """
    found = dict(stored)
    for group, name in _FILES:
        place = stored.get(group, {}).get(name)
        if place is not None:
            found[group] = found[group] | {name: _file(root, place)}
    return found


def _file(root: DataRoot, place: str) -> str:
    """Return the whole path of a file or a store, with the path inside it after two colons."""
    outer, sign, inner = place.partition("::")
    whole = root.resolve(outer)
    if whole.is_dir():
        root.check_links(whole)
    return f"{whole}{sign}{inner}"
