"""The axes of an HDF5 data set: as HyperSpy, EMD, Velox, NeXus and HDF5's own dimension scales name them."""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray

from ..axes import Axis, evenly
from ..calibration import as_number
from ..checks import DAMAGE, words

VELOX = re.compile(r"/Data/Image/[^/]+/Data")
"""The path of the images of a Velox file."""

_MOST_VALUES, _MOST_GROUPS, _DEEPEST = 1 << 22, 2000, 16


def axes_of(dataset: Any, where: str, file: Any) -> tuple[list[Axis], tuple[str, ...]]:
    """Return what a file says of each axis of a data set; nothing, and a note, where that is damaged.

    ``file`` is that which the user named: groups of it may link to the data set, and name its axes.
    """
    odd: list[str] = []
    try:
        nexus = partial(_nexus, odd=odd), partial(_linked, file=file, odd=odd)
        for known in (_velox, _hyperspy, _emd, *nexus, _scales):
            if axes := known(dataset):
                fitting = [_of_length(axis, length, odd) for axis, length in zip(axes, dataset.shape, strict=True)]
                return fitting, tuple(f"{where}: {one}" for one in odd)
    except DAMAGE as error:
        return [Axis()] * dataset.ndim, (f"{where}: its axes cannot be read ({words(error)})",)
    return [Axis()] * dataset.ndim, ()


def _of_length(axis: Axis, length: int, odd: list[str]) -> Axis:
    """Return an axis without its places where they are not one for each element: EMD may list two, NeXus the edges."""
    count = length if axis.values is None else len(axis.values)
    if count not in (1, 2, length, length + 1):
        odd.append(f"its axis {axis} lists {count:,} places for {length:,} elements; only their step is used")
    return axis if count == length else replace(axis, values=None)


def single(item: Any, name: str) -> Any:
    """Return an attribute that holds one value; empty where it is not there, or holds many."""
    if not name or name not in item.attrs or item.attrs.get_id(name).shape not in ((), (1,)):
        return ""
    return item.attrs[name]


def text(value: Any) -> str:
    """Return a text however it is stored."""
    value = value.item() if isinstance(value, np.ndarray) and value.size == 1 else value
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def within(group: Any, name: str, kind: type) -> Any:
    """Return a member that lies in the same file; None where it is not there: no other file is opened for a unit."""
    item = _member(group, name)
    link = None if item is not None or not isinstance(group, h5py.Group) else group.get(name, getlink=True)
    if isinstance(link, h5py.SoftLink):
        item = group.file["/"] if link.path.startswith("/") else group
        for part in filter(None, link.path.split("/")):
            item = _member(item, part)
    return item if isinstance(item, kind) else None


def _member(group: Any, name: str) -> Any:
    """Return a member that is no link; None where there is none."""
    there = isinstance(group, h5py.Group) and isinstance(group.get(name, getlink=True), h5py.HardLink)
    return group[name] if there else None


def numbers_of(dataset: Any) -> NDArray[np.float64] | None:
    """Return the numbers of a data set with one axis; None where they are texts or others, or too many."""
    if dataset.ndim != 1 or dataset.dtype.kind not in "iuf" or not 0 < dataset.shape[0] <= _MOST_VALUES:
        return None
    if dataset.chunks and math.prod(dataset.chunks) > _MOST_VALUES:
        return None
    return np.asarray(dataset[()], np.float64)


def _velox(dataset: Any) -> list[Axis]:
    fits = VELOX.fullmatch(dataset.name or "") and dataset.ndim == 3
    return [Axis("y"), Axis("x"), Axis("frame")] if fits else []


def _hyperspy(dataset: Any) -> list[Axis]:
    group = dataset.parent
    found = [within(group, f"axis-{k}", h5py.Group) for k in range(dataset.ndim)]
    return [Axis() if item is None else _hyperspy_axis(item) for item in found] if any(found) else []


def _hyperspy_axis(item: Any) -> Axis:
    navigate = single(item, "navigate")
    values = within(item, "axis", h5py.Dataset)
    listed = None if values is None else numbers_of(values)
    return Axis(
        text(single(item, "name")),
        text(single(item, "units")),
        as_number(single(item, "scale")) if listed is None else evenly(listed),
        None if isinstance(navigate, str | bytes) else not bool(navigate),
        listed,
    )


def _emd(dataset: Any) -> list[Axis]:
    """Return the axes of an EMD group; those that HyperSpy wrote without names are in the order x, y, frame."""
    group = dataset.parent
    names = sorted((name for name in group if re.fullmatch(r"dim\d{1,3}", name)), key=lambda name: int(name[3:]))
    if "emd_group_type" not in group.attrs or len(names) < dataset.ndim:
        return []
    found = [within(group, name, h5py.Dataset) for name in names[: dataset.ndim]]
    axes = [Axis() if item is None else _listed(item, "name") for item in found]
    if "record_by" in group.attrs and not any(axis.name for axis in axes) and dataset.ndim in (2, 3):
        said = zip(("x", "y", "frame"), axes, strict=False)
        return [Axis(name, axis.unit, axis.scale, axis.in_image, axis.values) for name, axis in said]
    return axes


def _listed(item: Any, name: str) -> Axis:
    """Return an axis whose places, or the first two of them, are a data set."""
    values = numbers_of(item)
    step = math.nan if values is None else evenly(values)
    return Axis(text(single(item, name)), text(single(item, "units")), step, values=values)


def _nexus(dataset: Any, odd: list[str]) -> list[Axis]:
    group, short = dataset.parent, (dataset.name or "").rpartition("/")[2]
    is_signal = text(single(group, "signal")) == short and "axes" in group.attrs
    return _by_nexus(dataset, group, group if is_signal else dataset, odd)


def _by_nexus(dataset: Any, group: Any, holder: Any, odd: list[str]) -> list[Axis]:
    """Return the axes that an attribute of ``holder`` names and a group has; what is odd of them goes to ``odd``."""
    if "axes" not in holder.attrs:
        return []
    names = [text(name) for name in np.atleast_1d(holder.attrs["axes"])]
    if len(names) == 1:
        names = [name for name in re.split(r"[\s:,\[\]]+", names[0]) if name]
    first = _first_of(names, group, dataset, odd)
    places = [_place(group, name, k + first) for k, name in enumerate(names)]
    named = [name for name in names if name != "."]
    if len({*places} & {*range(dataset.ndim)}) < len(names) or len({*named}) < len(named):
        odd.append(f"its axes ({', '.join(names)}) contradict each other or its {dataset.ndim} axes, and are not used")
        return [Axis()] * dataset.ndim
    known = dict(zip(places, names, strict=True))
    return [_nexus_axis(group, known.get(k, ".")) for k in range(dataset.ndim)]


def _first_of(names: list[str], group: Any, dataset: Any, odd: list[str]) -> int:
    """Return which axis the first of fewer names than axes is of, by the lengths of what is listed; there is a note."""
    fewer = dataset.ndim - len(names)
    if fewer <= 0 or any(f"{name}_indices" in group.attrs for name in names):
        return 0
    lengths = [None if item is None else item.size for item in (within(group, name, h5py.Dataset) for name in names)]
    for first in (0, fewer):
        shape = dataset.shape[first : first + len(names)]
        pairs = list(zip(lengths, shape, strict=True))
        if any(lengths) and all(one in (None, length, length + 1) for one, length in pairs):
            side = "first" if not first else "last"
            odd.append(f"it names {len(names)} of its {dataset.ndim} axes ({', '.join(names)}), taken for its {side}")
            return first
    return len(dataset.shape)  # none fits


def _linked(dataset: Any, file: Any, odd: list[str]) -> list[Axis]:
    """Return the axes by a group of NeXus whose signal is a link to the data set."""
    waiting, looked = deque([file["/"]]), 0
    while waiting and looked < _MOST_GROUPS:
        group = waiting.popleft()
        signal = text(single(group, "signal"))
        if signal and _leads_to(group, signal, dataset):
            return _by_nexus(dataset, group, group, odd)
        for name in islice(group, _MOST_GROUPS):
            looked += 1
            if isinstance(item := _member(group, name), h5py.Group) and item.name.count("/") < _DEEPEST:
                waiting.append(item)
    return []


def _leads_to(group: Any, name: str, dataset: Any) -> bool:
    """Tell whether a member of a group is a link to a data set, by its text alone."""
    link = group.get(name, getlink=True)
    if not isinstance(link, h5py.SoftLink | h5py.ExternalLink):
        return False
    other = isinstance(link, h5py.ExternalLink)
    path = link.path if other or link.path.startswith("/") else f"{group.name}/{link.path}"
    holder = Path(link.filename if other else group.file.filename).name
    return (path.strip("/"), holder) == (dataset.name.strip("/"), Path(dataset.file.filename).name)


def _place(group: Any, name: str, usual: int) -> int:
    given = as_number(single(group, f"{name}_indices"))
    return int(given) if given == given and abs(given) < 100 else usual


def _nexus_axis(group: Any, name: str) -> Axis:
    item = within(group, name, h5py.Dataset) if name != "." else None
    found = Axis() if item is None else _listed(item, "")
    return Axis("" if name == "." else name, found.unit, found.scale, values=found.values)


def _scales(dataset: Any) -> list[Axis]:
    """Return the axes by HDF5's labels and dimension scales, as netCDF has them."""
    axes = [_scale(dataset.dims[k]) for k in range(dataset.ndim)]
    return axes if any(axis.name for axis in axes) else []


def _scale(dimension: Any) -> Axis:
    if not len(dimension):
        return Axis(dimension.label)
    item = dimension[0]
    found = _listed(item, "")
    return Axis(dimension.label or (item.name or "").rpartition("/")[2], found.unit, found.scale, values=found.values)


def is_signal(dataset: Any) -> bool:
    """Tell whether its group says that a data set is what the group is about."""
    group, short = dataset.parent, (dataset.name or "").rpartition("/")[2]
    rules: tuple[Callable[[], bool], ...] = (
        lambda: bool(VELOX.fullmatch(dataset.name or "")),
        lambda: "emd_group_type" in group.attrs and not short.startswith("dim"),
        lambda: text(single(group, "signal")) == short,
        lambda: short == "data" and within(group, "axis-0", h5py.Group) is not None,
    )
    try:
        return any(rule() for rule in rules)
    except DAMAGE:
        return False
