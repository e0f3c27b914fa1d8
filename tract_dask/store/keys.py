"""The keys of stages: an algorithm's number, the settings that count, by names that stay, and what was read.

The names and the released defaults stand here, and not only in the classes of :mod:`tract_dask.settings`: a class that
is renamed or moved, and a new setting with its default, change no key. A released default is part of its stage's
algorithm. Where it changes, change it here too, and raise the stage's number in :data:`ALGORITHMS`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from ..settings.declare import Settings

ALGORITHMS = {"convert": 2, "drift": 2, "sum": 2, "columns": 2, "fit": 2}
"""The number of each stage's algorithm, which is in its keys. Raise it where the stage's results, or a default, change.

A version of the package that leaves them as they are makes nothing anew. ``tests/store/test_algorithms.py`` holds
number, defaults and results of each stage together.
"""

Part: TypeAlias = str | bytes | int | float | bool | list[Any] | tuple[Any, ...] | dict[str, Any] | NDArray[Any] | None
"""What a key can be made of."""


@dataclass(frozen=True)
class Keyed:
    """A setting that counts in a key.

    Attributes
    ----------
    name
        Its name in keys, for ever.
    default
        Its released default, which is in no key.
    place
        Where it is today, as ``group.field`` of :class:`tract_dask.settings.RunSettings`; empty: as its name says.
    """

    name: str
    default: Any
    place: str = ""

    def value(self, groups: dict[str, Settings]) -> Any:
        """Return the setting's value, as JSON has it."""
        group, _, field = (self.place or self.name).partition(".")
        return plain(getattr(groups[group], field))


KEYED: dict[str, tuple[Keyed, ...]] = {
    "convert": (
        Keyed("source.raw_shape", None),
        Keyed("source.raw_dtype", None),
        Keyed("source.raw_offset", 0),
        Keyed("source.frames", None),
        Keyed("source.roi", None),
        Keyed("source.bin", 1),
        Keyed("convert.shard_mb", 256.0),
        Keyed("convert.tile_px", 256),
        Keyed("convert.codec", "lz4"),
        Keyed("convert.find_defects", True),
        Keyed("convert.gain_reference_by", "multiply"),
    ),
    "drift": (Keyed("drift.method", "auto"), Keyed("drift.search_px", None)),
    "sum": (),
    "columns": (
        Keyed("columns.method", "auto"),
        Keyed("columns.contrast", "auto"),
        Keyed("columns.lattices", ()),
        Keyed("columns.spacing_px", None),
        Keyed("columns.search_radius_px", None),
        Keyed("columns.centroid_radius_px", None),
        Keyed("columns.min_amplitude", 0.15),
        Keyed("columns.detection_threshold", 5.0),
        Keyed("columns.template", None),
        Keyed("fit.window_px", None),
        Keyed("fit.blur_sigma_px", None),
    ),
    "fit": (
        Keyed("fit.estimator", "lsq"),
        Keyed("fit.shape", "fixed"),
        Keyed("fit.filter", "gaussian"),
        Keyed("fit.blur_sigma_px", None),
        Keyed("fit.wiener_background", 1.0),
        Keyed("fit.wiener_cutoff", 0.3),
        Keyed("fit.tv_fidelity", 0.9),
        Keyed("fit.tv_iterations", 200),
        Keyed("fit.mask_radius_px", None),
        Keyed("fit.max_shift_px", None),
        Keyed("fit.sigma_factor", 1.3),
        Keyed("fit.amplitude_factor", 5.0),
        Keyed("fit.threshold", 1.6),
        Keyed("fit.counting", True),
        Keyed("fit.intensity_scale", "paper"),
        Keyed("fit.tolerance_px", 1e-4),
        Keyed("fit.max_iterations", 50),
        Keyed("fit.drift_columns", None),
        Keyed("fit.search_px", None),
        Keyed("fit.scan_rows", "off"),
    ),
}
"""The settings of each stage's key. The other settings count by what comes of them: :data:`OTHERWISE`."""

OTHERWISE = {
    "metadata.pixel_size_pm": "written down, in no key",
    "metadata.frame_time_s": "written down, in no key",
    "metadata.dose": "written down, in no key",
    "metadata.gain": "the movie's gain is in the keys of sum and fit",
    "metadata.offset": "the movie's offset is in the keys of sum and fit",
    "convert.dark": "the image's contents are in the key of convert",
    "convert.gain_reference": "the image's contents are in the key of convert",
    "convert.defects": "the file's contents are in the key of convert",
    "drift.csv": "the file's contents are in the key of drift",
    "fit.refine_drift": "fewest columns that refine, or none, are in the key of fit",
    "fit.refine_columns": "fewest columns that refine, or none, are in the key of fit",
    "columns.csv": "the file's contents are in the key of columns",
    "fit.window_px": "the window that is fitted is in the key of fit",
    "fit.vacuum_box": "the box that is looked at is in the key of fit",
}
"""How settings count that are in no key by their own value, or in another stage's."""


def counted(stage: str, **groups: Settings) -> dict[str, Any]:
    """Return the settings of a stage's key that differ from their defaults, by name.

    Parameters
    ----------
    groups
        The groups of settings that hold them, named as in :class:`tract_dask.settings.RunSettings`.

    Examples
    --------
    >>> from tract_dask.settings import DriftSettings
    >>> counted("drift", drift=DriftSettings(search_px=12, method="auto"))
    {'drift.search_px': 12.0}
    """
    values = ((item, item.value(groups)) for item in KEYED[stage])
    return {item.name: value for item, value in values if value != plain(item.default)}


def default_of(stage: str, name: str) -> Any:
    """Return the released default of a setting by its name in keys; None where there is no such name any more."""
    return next((plain(item.default) for item in KEYED[stage] if item.name == name), None)


def stage_key(stage: str, *parts: Part) -> str:
    """Return the key of a stage's result: a hash of its algorithm's number, its settings and what it read.

    Two results with the same key are the same; a stage is done when its store carries the key that it should have.
    """
    return digest_of(stage, ALGORITHMS[stage], *parts)


def digest_of(*parts: Part) -> str:
    """Return a hash of some values, the same on every machine; numbers count by their value, whole ones or not."""
    digest = hashlib.sha256()
    for part in parts:
        data = b"".join(_bytes_of(part))
        digest.update(len(data).to_bytes(8, "big") + data)
    return digest.hexdigest()


def _bytes_of(part: Part) -> Iterator[bytes]:
    if isinstance(part, bytes):
        yield part
    elif isinstance(part, np.ndarray):
        array = np.ascontiguousarray(part, part.dtype.newbyteorder("<"))
        yield f"{array.dtype.str} {array.shape}".encode()
        yield array.tobytes()
    else:
        yield json.dumps(plain(part), sort_keys=True).encode()


def plain(value: Any) -> Any:
    """Return a value as JSON has it, all numbers as floats: whether one is whole tells nothing apart.

    Examples
    --------
    >>> plain(({"origin": (1, 2.5)}, True))
    [{'origin': [1.0, 2.5]}, True]
    """
    if isinstance(value, dict):
        return {str(name): plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    return value
