"""Settings as plain values and TOML."""

from __future__ import annotations

import dataclasses
import tomllib
import typing
from pathlib import Path
from typing import Any

import tomli_w

from ..errors import SettingsError, shown
from .cluster import ClusterSettings
from .declare import Settings, T, is_optional, plain_type
from .run import RunSettings


def to_dict(settings: Settings) -> dict[str, Any]:
    """Return the settings as nested mappings, without those that are unset."""
    return {
        item.name: to_dict(value) if isinstance(value, Settings) else value
        for item in dataclasses.fields(settings)
        if (value := getattr(settings, item.name)) is not None
    }


def to_toml(settings: Settings) -> str:
    """Return the settings as TOML text.

    Examples
    --------
    >>> from tract_dask.settings import FitSettings
    >>> from_toml(FitSettings, to_toml(FitSettings(window_px=31))).window_px
    31
    """
    return tomli_w.dumps(to_dict(settings))


def from_toml(kind: type[T], text: str, where: str = "settings") -> T:
    """Return settings of class ``kind`` from TOML text.

    Raises
    ------
    SettingsError
        Where the text is not TOML, or names a setting that does not exist, or a value is out of range.
    """
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(
            "this is not valid TOML", where, got=str(error), remedy="Correct the line that it names"
        ) from error
    return from_dict(kind, values, where)


def from_dict(kind: type[T], values: dict[str, Any], where: str = "settings") -> T:
    """Return settings of class ``kind`` from nested mappings; see :func:`from_toml`."""
    kinds = typing.get_type_hints(kind)
    names = [item.name for item in dataclasses.fields(kind)]  # type: ignore[arg-type]
    arguments: dict[str, Any] = {}
    for name, value in values.items():
        if name not in names:
            raise SettingsError(
                f"there is no setting {name!r}",
                where,
                f"one of {', '.join(names)}",
                name,
                "Correct its name; docs/settings.md lists them all",
            )
        nested = isinstance(kinds[name], type) and issubclass(kinds[name], Settings)
        if nested and not isinstance(value, dict):
            raise SettingsError(
                f"{name!r} is a group of settings", where, f"a table [{name}]", shown(value), "Give it a table"
            )
        arguments[name] = from_dict(kinds[name], value, f"{where} [{name}]") if nested else value
    return kind(**arguments)


def assigned(text: str) -> tuple[tuple[str, ...], Any]:
    """Return the path and the value of a run's setting that is written as ``group.name=value``; None where it is unset.

    Text needs no quotes, and a list no brackets.

    Raises
    ------
    SettingsError
        Where there is no such setting, or no value.

    Examples
    --------
    >>> assigned("fit.vacuum_box=0,64,0,64")
    (('fit', 'vacuum_box'), [0, 64, 0, 64])
    """
    name, equals, said = text.partition("=")
    path = tuple(name.strip().split("."))
    kind: Any = RunSettings
    for part in path:
        kinds = typing.get_type_hints(kind) if dataclasses.is_dataclass(kind) else {}
        if part not in kinds:
            expected = f"one of {', '.join(kinds)}" if kinds else f"{name.rpartition('.')[0]} without a further name"
            remedy = "Correct its name; docs/settings.md lists them all"
            raise SettingsError(f"there is no setting {part!r}", f"--set {text}", expected, name, remedy)
        kind = kinds[part]
    if not equals or dataclasses.is_dataclass(kind):
        remedy = "Write it as group.name=value, such as fit.window_px=31"
        raise SettingsError("a setting and its value are needed", f"--set {text}", "group.name=value", text, remedy)
    said = said.strip()
    unset = said == "unset" and (is_optional(kind) or plain_type(kind) is tuple)
    return path, None if unset else value(said, kind)


def value(text: str, annotation: Any) -> Any:
    """Return the value of a setting from what a command line says; text that is no such value comes back unchanged."""
    kind = plain_type(annotation)
    try:
        if kind in (int, float, str):
            return kind(text)
        if kind is tuple and not text.startswith("["):
            if str in typing.get_args(annotation):
                return text.split(",")
            text = f"[{text}]"
        return tomllib.loads(f"value = {text}")["value"]
    except ValueError:
        return text


def load(path: Path) -> RunSettings:
    """Return the settings in a TOML file, such as the run.toml that every run writes.

    Raises
    ------
    SettingsError
        As :func:`from_toml`, and where the file cannot be read.
    """
    return from_toml(RunSettings, _text(path), str(path))


def load_cluster(path: Path) -> ClusterSettings:
    """Return the settings of a cluster in a TOML file of its own.

    Raises
    ------
    SettingsError
        As :func:`load`.
    """
    return from_toml(ClusterSettings, _text(path), str(path))


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(
            "the settings file cannot be read", str(path), "a TOML file", str(error), "Check its path"
        ) from error
