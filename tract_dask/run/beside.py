"""Checks of the small files that lie beside the stores of a run: its settings, table, figure, report and events."""

from __future__ import annotations

import hashlib
import json
import os
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

from ..errors import SettingsError, StoreError
from ..settings import toml as declared
from ..settings.declare import Settings
from ..settings.run import ColumnSettings, ConvertSettings, DriftSettings, FitSettings, RunSettings, SourceSettings
from ..store import metadata
from ..store.columns import MOST_BYTES, parse_columns_csv
from ..store.files import read_small
from ..store.keys import counted
from ..store.run_folder import COLUMNS, DRIFT, MOVIE, RESULTS, RunFolder
from .faults import Fault

_AGAIN = "Run the same command again: it writes the file again"
_EVENTS_BYTES = 1 << 30
_END_BYTES = 64

_GROUPS: dict[str, tuple[str, dict[str, type[Settings]]]] = {
    MOVIE: ("convert", {"settings": ConvertSettings, "source_settings": SourceSettings}),
    DRIFT: ("drift", {"settings": DriftSettings}),
    COLUMNS: ("columns", {"settings": ColumnSettings}),
    RESULTS: ("fit", {"settings": FitSettings}),
}
"""Of a run's stores: the stage, and the settings that the store remembers, by the attribute that holds them."""

_PNG = b"\x89PNG\r\n\x1a\n"

_BY_LAYOUT = {"convert.shard_mb", "convert.tile_px"}
"""Settings that need not be the same for the same store."""

_FOLLOWING = {"fit.blur_sigma_px"}
"""Settings that follow the columns where a run leaves them open; stores say what they became."""


@dataclass(frozen=True)
class Beside:
    """What was found of the small files of a run.

    Attributes
    ----------
    notes
        Sentences on what is no fault, and good to know.
    files
        How many were read.
    """

    faults: tuple[Fault, ...]
    notes: tuple[str, ...]
    files: int


def look_beside(folder: Path, found: Sequence[Path]) -> Beside:
    """Check the small files in the folder of a run, or of single stages, whose stores are ``found``."""
    about = {store: known for store in found if (known := _known(store))}
    tables = [store for store, known in about.items() if known.get("kind") == "columns" and known.get("complete")]
    checks: list[tuple[Path, Callable[[Path], str], str]] = [
        (RunFolder(folder).settings, partial(_settings, about=about), _AGAIN),
        (RunFolder(folder).events, _events, "Remove it: it is a record that nothing needs"),
        (RunFolder(folder).report, _report, f"tract-dask report {folder} writes it again"),
    ]
    for store in tables:
        csv, png = store.with_suffix(".csv"), store.with_suffix(".png")
        repair = f"Repair {csv}, or remove it and run the same command again: then columns are found again"
        checks.append((csv, partial(_table, about=about[store]), repair))
        checks.append((png, _figure, f"Remove {png} and run the same command again"))
    needed = {store.with_suffix(".csv") for store in tables}
    needed |= {RunFolder(folder).settings} if (RunFolder(folder).events).exists() else set()
    faults, notes, files = list[Fault](), list[str](), 0
    for file, check, remedy in checks:
        there = os.path.lexists(file)
        files += there
        if there or file in needed:
            try:
                notes += [note] if (note := check(file)) else []
            except (OSError, ValueError, SettingsError) as error:
                faults.append(_fault(file, error, remedy))
    return Beside(tuple(faults), tuple(notes), files)


def _known(store: Path) -> dict[str, Any]:
    """Return what a store says of itself; nothing where it is damaged, which is told elsewhere."""
    try:
        return metadata.attributes(store)
    except StoreError:
        return {}


def _fault(file: Path, error: Exception, remedy: str) -> Fault:
    stage = "columns" if file.suffix in (".csv", ".png") else "run"
    if isinstance(error, FileNotFoundError):
        return Fault(file, file.parent, stage, "missing", "no such file", help=remedy)
    if isinstance(error, OSError) and not file.is_dir():
        return Fault(file, file.parent, stage, "unreadable", error.strerror or str(error))
    why = "a folder" if file.is_dir() else str(error)
    return Fault(file, file.parent, stage, "damaged", why, help=remedy)


def _settings(file: Path, about: dict[Path, dict[str, Any]]) -> str:
    """Check the settings of a run; return which stores were made with others, in words."""
    lines = read_small(file, MOST_BYTES).decode(errors="replace").splitlines()
    now = declared.load(file)
    if left_out := [group.name for group in fields(now) if f"[{group.name}]" not in lines]:
        raise ValueError(f"the file ends too early, without the settings of {', '.join(left_out)}")
    differing = {store.name: names for store, known in about.items() if (names := _others(store, known, now))}
    words = "; ".join(f"{name} ({', '.join(names)})" for name, names in differing.items())
    return f"{file}: its settings are not those of {words}, as after a run that did not end" if words else ""


def _others(store: Path, about: dict[str, Any], now: RunSettings) -> list[str]:
    """Return the names of settings that a store was made with and that differ from those of the run."""
    stage, kinds = _GROUPS.get(store.name, ("", {}))
    if not stage:
        return []
    try:
        then = {name: declared.from_toml(kind, str(about.get(name, ""))) for name, kind in kinds.items()}
    except SettingsError:  # of a version with other settings
        return []
    before = counted(stage, **_groups(now) | {_group(group): group for group in then.values()})
    after = counted(stage, **_groups(now))
    left_out = _BY_LAYOUT | (_FOLLOWING - after.keys())
    return sorted(name for name in {*before, *after} - left_out if before.get(name) != after.get(name))


def _groups(settings: RunSettings) -> dict[str, Settings]:
    return {name: getattr(settings, name) for name in ("source", "convert", "drift", "columns", "fit")}


def _group(group: Settings) -> str:
    return next(name for name, value in _groups(RunSettings()).items() if type(value) is type(group))


def _table(file: Path, about: dict[str, Any]) -> str:
    """Check a table of columns; return that it is another than its store was made from, in words."""
    data = read_small(file, MOST_BYTES)
    columns = parse_columns_csv(data.decode("utf-8-sig"), str(file))
    if hashlib.sha256(data).hexdigest() == about.get("table"):
        return ""
    n = columns.sizes["column_id"]
    return f"{file}: changed since columns were found; the same run again refines and fits the {n} columns in it"


def _events(file: Path) -> str:
    torn = 0
    for line in read_small(file, _EVENTS_BYTES).splitlines():
        try:
            json.loads(line or b"0")
        except ValueError:
            torn += 1
    return f"{file}: {torn} of its lines are not whole, as a run that was killed leaves them" if torn else ""


def _report(file: Path) -> str:
    with file.open("rb") as opened:
        opened.seek(max(0, file.stat().st_size - _END_BYTES))
        if not opened.read().rstrip().endswith(b"</html>"):
            raise ValueError("the file ends too early")
    return ""


def _figure(file: Path) -> str:
    data, place, kind = read_small(file, MOST_BYTES), len(_PNG), b""
    while data.startswith(_PNG) and place < len(data):
        end = place + 8 + int.from_bytes(data[place : place + 4], "big")
        if zlib.crc32(data[place + 4 : end]).to_bytes(4, "big") != data[end : end + 4]:
            raise ValueError("a part of the picture has another checksum")
        kind, place = data[place + 4 : place + 8], end + 4
    if kind != b"IEND":
        raise ValueError("no picture, or a part of one")
    return ""
