"""What the metadata of a Zarr store say: arrays, chunks, axes and units, of Zarr 2 and 3."""

from __future__ import annotations

import math
import re
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import zarr

from ..axes import Axis, evenly
from ..calibration import as_number
from ..checks import words
from ..hdf5.candidates import Found
from .place import Place, plain_path
from .shards import ShardIndex, shard_index

_MOST_NODES, _MOST_VALUES = 10_000, 1 << 22

_UNITS = {
    "picometer": "pm",
    "nanometer": "nm",
    "angstrom": "angstrom",
    "micrometer": "um",
    "millimeter": "mm",
    "meter": "m",
    "nanosecond": "ns",
    "microsecond": "us",
    "millisecond": "ms",
}
"""Units as OME-Zarr spells them."""

_OME_KINDS = {"time": "time", "channel": "channel"}
"""Names for axes of which OME-Zarr says the type, under whatever name."""

_OLD_AXES = ("t", "c", "z", "y", "x")
"""The axes of OME-Zarr before it named them."""


_UNKNOWN = np.dtype(object)


@dataclass(frozen=True)
class Node:
    """A group, or an array where ``shape`` is not None.

    Attributes
    ----------
    name
        Its path in the store.
    attributes
        What it says of itself.
    shape, chunk
        Of the array, and of one file of it: a shard, where there are shards.
    dtype
        As its metadata name it; object where NumPy has no such type.
    names
        Of its dimensions; empty where it has none.
    keys
        Pattern of the paths of its chunks' files.
    codecs
        Names of what its chunks went through.
    index
        Of its shards; None where there are none, or theirs cannot be read here.
    """

    name: str
    attributes: dict[str, Any]
    shape: tuple[int, ...] | None = None
    chunk: tuple[int, ...] = ()
    dtype: np.dtype[Any] = _UNKNOWN
    names: tuple[str, ...] = ()
    keys: str = ""
    codecs: tuple[str, ...] = ()
    index: ShardIndex | None = None


def node_at(place: Place, name: str) -> Node | None:
    """Return what is at a path in a store; None where there is neither array nor group.

    Raises
    ------
    ValueError, KeyError, TypeError
        Where its metadata are damaged.
    """
    before = f"{name}/" if name else ""
    if (found := place.json(f"{before}zarr.json")) is not None:
        attributes = _object(found.get("attributes"))
        return _array_of_3(name, attributes, found) if found.get("node_type") == "array" else Node(name, attributes)
    array = place.json(f"{before}.zarray")
    if array is None and place.json(f"{before}.zgroup") is None:
        return None
    attributes = _object(place.json(f"{before}.zattrs"))
    return Node(name, attributes) if array is None else _array_of_2(name, attributes, array)


def _array_of_3(name: str, attributes: dict[str, Any], found: dict[str, Any]) -> Node:
    encoding = _object(found.get("chunk_key_encoding"))
    plain = encoding.get("name") == "v2"
    sign = re.escape(str(_object(encoding.get("configuration")).get("separator", "." if plain else "/")))
    shape = _lengths(found["shape"])
    codecs = [codec for codec in found["codecs"] if isinstance(codec, dict)]
    inner = [one for codec in codecs for one in _object(codec.get("configuration")).get("codecs", ())]
    return Node(
        name,
        attributes,
        shape,
        _lengths(found["chunk_grid"]["configuration"]["chunk_shape"], len(shape)),
        _dtype(found["data_type"]),
        tuple(item if isinstance(item, str) else "" for item in found.get("dimension_names") or ()),
        ("" if plain else f"c{sign}") + sign.join([r"(\d+)"] * len(shape)),
        tuple(str(codec.get("name")) for codec in (*codecs, *(one for one in inner if isinstance(one, dict)))),
        shard_index(codecs),
    )


def _array_of_2(name: str, attributes: dict[str, Any], found: dict[str, Any]) -> Node:
    shape, sign = _lengths(found["shape"]), re.escape(str(found.get("dimension_separator", ".")))
    codecs = [codec for codec in (found.get("compressor"), *(found.get("filters") or ())) if isinstance(codec, dict)]
    names = attributes.get("_ARRAY_DIMENSIONS")
    return Node(
        name,
        attributes,
        shape,
        _lengths(found["chunks"], len(shape)),
        _dtype(found["dtype"]),
        tuple(map(str, names)) if isinstance(names, list) else (),
        sign.join([r"(\d+)"] * len(shape)),
        tuple(str(codec.get("id")) for codec in codecs),
    )


def _object(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _lengths(values: Any, n_axes: int | None = None) -> tuple[int, ...]:
    found = tuple(int(value) for value in values)
    if min(found, default=1) < (0 if n_axes is None else 1) or max(found, default=0) >= 1 << 62 or len(found) > 32:
        raise ValueError(f"the lengths {found} are impossible")
    if n_axes is not None and len(found) != n_axes:
        raise ValueError(f"chunks {found} of an array with {n_axes} axes")
    return found


def _dtype(named: Any) -> np.dtype[Any]:
    try:
        return np.dtype([tuple(item) for item in named] if isinstance(named, list) else named)
    except (TypeError, ValueError):
        return _UNKNOWN


def arrays_below(place: Place, top: Node) -> tuple[list[Found], list[str]]:
    """Return the arrays below a group, of an image with several levels the largest; and what cannot be read."""
    found: list[Found] = []
    lost: list[str] = []
    waiting, looked = deque([top]), 0
    while waiting:
        at = waiting.popleft()
        if at.shape is not None:
            found.append(Found(f"/{at.name}", at.shape, at.dtype, "multiscale" in at.attributes))
            continue
        names = [largest] if (largest := largest_level(at)) else place.folders(at.name)
        looked += len(names)
        if looked > _MOST_NODES:
            raise ValueError(f"the store holds more than {_MOST_NODES:,} groups and arrays; name one of them")
        for name in names:
            node = _look(place, f"{at.name}/{name}".strip("/"), lost)
            if node is not None:
                signal = bool(largest) or (name == "data" and "axis-0" in names)
                waiting.append(replace(node, attributes={"multiscale": True}) if signal and node.shape else node)
    return found, lost


def _look(place: Place, name: str, lost: list[str]) -> Node | None:
    try:
        return node_at(place, plain_path(name))
    except (OSError, ValueError, LookupError, TypeError, AttributeError) as error:
        lost.append(f"/{name} cannot be read: {words(error)}")
        return None


def _multiscale(group: Node | None) -> dict[str, Any]:
    """Return what a group says of its levels; empty where it has none."""
    if group is None:
        return {}
    found = _object(group.attributes.get("ome", group.attributes)).get("multiscales")
    return _object(found[0]) if isinstance(found, list) and found else {}


def largest_level(group: Node) -> str:
    """Return the path, in its group, of the largest level of an OME-Zarr image; empty where the group is none."""
    levels = _multiscale(group).get("datasets")
    found = _object(levels[0]).get("path") if isinstance(levels, list) and levels else ""
    return found if isinstance(found, str) else ""


def axes_of(place: Place, array: Node) -> tuple[list[Axis], str]:
    """Return what a store says of each axis of an array, and the name of the convention."""
    assert array.shape is not None
    above = array.name.rpartition("/")[0]
    for name in dict.fromkeys((above, above.rpartition("/")[0], "")):
        group = node_at(place, name) if name != array.name else None
        if group is not None and (axes := _ome(group, array)):
            return [_better(axis, one) for axis, one in zip(axes, _named(place, array), strict=True)], "OME-Zarr"
    hyperspy = [_hyperspy(node_at(place, f"{above}/axis-{k}".strip("/"))) for k in range(len(array.shape))]
    if any(axis is not None for axis in hyperspy):
        return [axis or Axis() for axis in hyperspy], "HyperSpy Zarr"
    return _named(place, array), "Zarr"


def _ome(group: Node, array: Node) -> list[Axis]:
    """Return the axes by OME-Zarr; nothing where the array is none of the group's levels."""
    said = _multiscale(group)
    inside = array.name.removeprefix(group.name).strip("/")
    levels = [_object(level) for level in said.get("datasets") or ()]
    level = next((level for level in levels if str(level.get("path", "")).strip("/") == inside), None)
    assert array.shape is not None
    if level is None:
        return []
    n_axes = len(array.shape)
    named = said.get("axes") or _OLD_AXES[-n_axes:]
    if len(named) != n_axes:
        return []
    scale = np.ones(n_axes)
    for found in (said.get("coordinateTransformations"), level.get("coordinateTransformations")):
        for one in found or ():
            factors = [as_number(value) for value in _object(one).get("scale") or ()]
            scale = scale * factors if len(factors) == n_axes else scale
    return [_ome_axis(axis, step) for axis, step in zip(named, scale.tolist(), strict=True)]


def _ome_axis(axis: Any, step: float) -> Axis:
    if isinstance(axis, str):
        return Axis(axis, "", step)
    unit = str(_object(axis).get("unit") or "")
    found = Axis(str(_object(axis).get("name", "")), _UNITS.get(unit.lower(), unit), step)
    meant = _OME_KINDS.get(str(_object(axis).get("type")), "")
    return found if Axis(found.name).kind or not meant else replace(found, name=meant)


def _better(axis: Axis, coordinate: Axis) -> Axis:
    """Return an axis with the places that the store lists for it, where they have a unit."""
    return replace(coordinate, name=axis.name) if coordinate.values is not None and coordinate.unit else axis


def _hyperspy(node: Node | None) -> Axis | None:
    if node is None:
        return None
    said = node.attributes
    navigate = said.get("navigate")
    unit = said.get("units")
    return Axis(
        str(said.get("name", "")),
        unit if isinstance(unit, str) else "",
        as_number(said.get("scale", math.nan)),
        not navigate if isinstance(navigate, bool) else None,
    )


def _named(place: Place, array: Node) -> list[Axis]:
    """Return the axes by the names of dimensions, with the arrays of these names beside it."""
    assert array.shape is not None
    if len(array.names) != len(array.shape):
        return [Axis()] * len(array.shape)
    above = array.name.rpartition("/")[0]
    return [_coordinate(place, above, name, length) for name, length in zip(array.names, array.shape, strict=True)]


def _coordinate(place: Place, above: str, name: str, length: int) -> Axis:
    """Return an axis with its places, where the array of this name in the same group has so many."""
    path = f"{above}/{name}".strip("/")
    node = node_at(place, path) if re.fullmatch(r"\w[\w .-]*", name) else None
    if node is None or node.shape != (length,) or length > _MOST_VALUES or node.dtype.kind not in "iuf":
        return Axis(name)
    unit = node.attributes.get("units")
    values = np.asarray(open_node(place, node)[...], np.float64)
    return Axis(name, unit if isinstance(unit, str) else "", evenly(values), values=values)


def open_node(place: Place, node: Node) -> Any:
    """Return an array as Zarr reads it.

    Raises
    ------
    ValueError
        Where its chunks can be read only by running what is in them.
    """
    if unsafe := [name for name in node.codecs if "pickle" in name.lower()]:
        raise ValueError(f"the codec {unsafe[0]} runs whatever is in the file, and is not used")
    if math.prod(node.chunk) > 1 << 40:
        raise ValueError(f"chunks {node.chunk} are impossible")
    within = getattr(place, "within", "")
    return zarr.open_array(place.store(), path=f"{within}{node.name}", mode="r")
