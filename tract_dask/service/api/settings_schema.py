"""The settings as they are declared, for people and for programs: a row each, and a JSON schema."""

from __future__ import annotations

import dataclasses
import typing
from collections.abc import Iterator
from typing import Any

from ...settings.declare import Settings, is_optional, plain_type
from ...settings.run import TITLES, RunSettings

FIXED_GROUPS = ("cluster",)
"""Groups that the service decides on, not a job."""

_JSON_TYPES: dict[Any, str] = {bool: "boolean", int: "integer", float: "number", str: "string", tuple: "array"}


def declared() -> Iterator[tuple[str, dataclasses.Field[Any], Any]]:
    """Yield the group, the field and the type of every setting that a job may have."""
    for group, kind in groups().items():
        kinds = typing.get_type_hints(kind)
        for item in dataclasses.fields(kind):
            yield group, item, kinds[item.name]


def groups() -> dict[str, type[Settings]]:
    """Return the groups of settings that a job may have, by name."""
    return {name: kind for name, kind in typing.get_type_hints(RunSettings).items() if name not in FIXED_GROUPS}


def setting_rows() -> list[dict[str, Any]]:
    """Return a row for every setting, in the order of the declarations."""
    return [
        {
            "group": group,
            "title": TITLES[group],
            "name": item.name,
            "type": _JSON_TYPES[plain_type(annotation)],
            "items": _items(annotation),
            "optional": is_optional(annotation),
            "default": item.default,
            **{key: item.metadata[key] for key in ("unit", "description", "low", "high", "choices", "words")},
        }
        for group, item, annotation in declared()
    ]


def settings_schema() -> dict[str, Any]:
    """Return the JSON schema of a job's settings."""
    properties: dict[str, Any] = {
        group: {"type": "object", "title": TITLES[group], "additionalProperties": False, "properties": {}}
        for group in groups()
    }
    for group, item, annotation in declared():
        properties[group]["properties"][item.name] = _schema(item, annotation)
    return {"type": "object", "additionalProperties": False, "properties": properties}


def _schema(item: dataclasses.Field[Any], annotation: Any) -> dict[str, Any]:
    meta = item.metadata
    kind = _JSON_TYPES[plain_type(annotation)]
    schema: dict[str, Any] = {"type": [kind, "null"] if is_optional(annotation) else kind}
    if meta["words"]:
        schema["type"] = [kind, "string"]
    unit = f" ({meta['unit']})" if meta["unit"] else ""
    schema["description"] = f"{meta['description']}{unit}."
    schema |= {key: meta[name] for key, name in (("minimum", "low"), ("maximum", "high")) if meta[name] is not None}
    if meta["choices"]:
        schema["enum"] = list(meta["choices"])
    if kind == "array":
        schema["items"] = {"type": _items(annotation)}
    default = list(item.default) if isinstance(item.default, tuple) else item.default
    return schema | {"default": default}


def _items(annotation: Any) -> str | None:
    """Return what a list holds: whole numbers, or tables; None where it is no list."""
    if plain_type(annotation) is not tuple:
        return None
    arguments = [arg for part in (annotation, *typing.get_args(annotation)) for arg in typing.get_args(part)]
    return "object" if Any in arguments else "integer"
