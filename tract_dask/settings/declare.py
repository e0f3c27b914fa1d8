"""How settings are declared and checked."""

from __future__ import annotations

import dataclasses
import math
import re
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

from ..errors import SettingsError, shown

T = TypeVar("T")

MOST_ITEMS = 1000
"""Items of a setting that is a list."""

LINE = r"[^\n\r]+"

WORD = r"[A-Za-z0-9_.:,@+-]+"

WORD_FORM = "letters, digits and _ . : , @ + -"


def setting(
    default: Any,
    description: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    words: tuple[str, ...] = (),
    grouped: bool = False,
    common: bool = False,
    pattern: str = "",
    form: str = "",
    in_files_only: bool = False,
) -> Any:
    """Declare a setting: a dataclass field that carries its documentation and its range.

    Its option on the command line has its name, after the name of its group where it is ``grouped``; ``--help`` lists
    the ``common`` ones. A setting that is ``in_files_only`` has no option. A number (``float | str``) may also be one
    of the ``words``. Text, or each text of a list, has to match ``pattern``, which ``form`` puts in words.
    """
    return field(
        default=default,
        metadata={
            "description": description,
            "unit": unit,
            "low": low,
            "high": high,
            "choices": choices,
            "words": words,
            "grouped": grouped,
            "common": common,
            "pattern": pattern,
            "form": form,
            "in_files_only": in_files_only,
        },
    )


def option(group: str, item: dataclasses.Field[Any]) -> str:
    """Return the option of a setting on the command line, such as ``--drift-csv``."""
    name = f"{group}_{item.name}" if item.metadata["grouped"] else item.name
    return "--" + name.replace("_", "-")


def subgroup(description: str) -> dict[str, Any]:
    """Return what a field that is a group of settings inside another carries: only a file can set it."""
    return dict(setting(None, description, in_files_only=True).metadata)


@dataclass(frozen=True)
class Settings:
    """A group of settings; construction checks every value.

    Raises
    ------
    SettingsError
        Naming the setting, its range or choices, and the value found.
    """

    def __post_init__(self) -> None:
        kinds = typing.get_type_hints(type(self))
        for item in dataclasses.fields(self):
            value = getattr(self, item.name)
            value = tuple(tuple(v) if isinstance(v, list) else v for v in value) if isinstance(value, list) else value
            if isinstance(value, int) and not isinstance(value, bool) and plain_type(kinds[item.name]) is float:
                value = float(value) if abs(value) < 2**1000 else math.inf
            object.__setattr__(self, item.name, value)
            word = isinstance(value, str) and value in item.metadata.get("words", ())
            if not isinstance(value, Settings) and not word:
                _check(type(self), item, kinds[item.name], value)


def plain_type(annotation: Any) -> Any:
    """Return the plain type behind ``X | None`` and ``tuple[...]``."""
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        annotation = next(arg for arg in typing.get_args(annotation) if arg is not type(None))
    return typing.get_origin(annotation) or annotation


def is_optional(annotation: Any) -> bool:
    """Tell whether a setting's annotation admits None."""
    return type(None) in typing.get_args(annotation)


def _check(owner: type, item: dataclasses.Field[Any], annotation: Any, value: Any) -> None:
    """Check the value of a setting against its type, words, choices, form and range; raises SettingsError."""
    meta = item.metadata
    where = f"setting {item.name} ({owner.__name__})"
    if value is None and is_optional(annotation):
        return
    kind = plain_type(annotation)
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise SettingsError(
            "the value is of the wrong type",
            where,
            " or ".join(("list" if kind is tuple else kind.__name__, *meta.get("words", ()))),
            shown(value),
            meta.get("description", ""),
        )
    if isinstance(value, tuple):
        _check_items(where, meta, annotation, value)
    if meta.get("choices") and value not in meta["choices"]:
        raise SettingsError(
            "there is no such choice",
            where,
            f"one of {', '.join(meta['choices'])}",
            shown(value),
            meta["description"],
        )
    if meta.get("pattern"):
        _check_text(where, meta, (value,) if isinstance(value, str) else value)
    low, high = meta.get("low"), meta.get("high")
    if isinstance(value, int | float) and not ((low is None or value >= low) and (high is None or value <= high)):
        bounds = " and ".join(
            part
            for part in (
                f"at least {low:g}" if low is not None else "",
                f"at most {high:g}" if high is not None else "",
            )
            if part
        )
        raise SettingsError(
            "the value is out of range",
            where,
            f"{bounds} {meta['unit']}".strip(),
            shown(value),
            meta["description"],
        )
    if isinstance(value, float) and not math.isfinite(value):
        raise SettingsError("the value is not finite", where, "a number", repr(value), meta["description"])


def _check_items(where: str, meta: Mapping[str, Any], annotation: Any, value: tuple[Any, ...]) -> None:
    """Check that a list is not too long, and that whole numbers are such where it holds whole numbers."""
    if len(value) > MOST_ITEMS:
        raise SettingsError("the list is too long", where, f"at most {MOST_ITEMS}", str(len(value)), "Shorten it")
    listed = next((arg for arg in typing.get_args(annotation) if typing.get_origin(arg) is tuple), annotation)
    if int in typing.get_args(listed) and not all(type(item) is int and abs(item) < 2**63 for item in value):
        raise SettingsError(
            "the list holds other values", where, "whole numbers", shown(list(value)), meta["description"]
        )


def _check_text(where: str, meta: Mapping[str, Any], texts: Iterable[Any]) -> None:
    for text in texts:
        if not isinstance(text, str) or not re.fullmatch(meta["pattern"], text):
            raise SettingsError("the text has the wrong form", where, meta["form"], shown(text), meta["description"])


def contradiction(name: str, expected: str, got: str, remedy: str) -> SettingsError:
    """Return the error for settings that contradict each other."""
    return SettingsError("settings contradict each other", f"setting {name} (ClusterSettings)", expected, got, remedy)
