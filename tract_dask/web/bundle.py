"""Several JavaScript modules as one script, for a page that is one file."""

from __future__ import annotations

import re
from pathlib import Path

STATIC = Path(__file__).parent / "static"
"""The modules and style sheets that all pages share."""

_IMPORT = re.compile(r'^import \{ (\w+(?:, \w+)*) \} from "\./([\w-]+\.js)";$', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=(?:async )?(?:const|function|class)\b)", re.MULTILINE)
_EXPORTED = re.compile(r"^export (?:async )?(?:const|function|class) (\w+)", re.MULTILINE)
_NOT_HERE = re.compile(
    r"^(?:import|export)\b.*|\bimport(?:\.meta|\s*\().*|</script.*|<!--.*", re.MULTILINE | re.IGNORECASE
)


def bundle(module: Path) -> str:
    """Return a module, with all that it imports before it, as a script that imports nothing.

    Every module keeps a scope of its own, so that no name of one meets that of another. Modules are looked for beside
    ``module`` and among the shared ones.

    Parameters
    ----------
    module
        Its imports are of the form ``import { a, b } from "./other.js";``, its exports stand before what they export:
        a function, a class or a constant.

    Raises
    ------
    ValueError
        Where an import or an export has another form, modules import one another in a circle, two files have one name,
        or a text would end the script.
    FileNotFoundError
        Where a module is missing.
    """
    parts: dict[str, str] = {}
    _add(module, module.parent, parts, ())
    return "\n".join(["const bundled = {};", *parts.values()])


def _add(file: Path, beside: Path, parts: dict[str, str], path: tuple[str, ...]) -> None:
    """Add a module to ``parts``, after those that it imports; ``path`` leads to it."""
    if file.name in path:
        raise ValueError(f"modules import one another: {' -> '.join((*path, file.name))}")
    source = file.read_text(encoding="utf-8")
    for found in _IMPORT.finditer(source):
        if found[2] not in parts:
            _add(_place(found[2], beside), beside, parts, (*path, file.name))
    body = _IMPORT.sub(r'const { \1 } = bundled["\2"];', source)
    body = _EXPORT.sub("", body)
    if bad := _NOT_HERE.search(body):
        raise ValueError(f"{file.name} cannot stand in a script: {bad[0]}")
    names = ", ".join(_EXPORTED.findall(source))
    parts[file.name] = f'bundled["{file.name}"] = (() => {{\n{body}return {{ {names} }};\n}})();'


def _place(name: str, beside: Path) -> Path:
    found = [folder / name for folder in dict.fromkeys((beside, STATIC)) if (folder / name).exists()]
    if len(found) > 1:
        raise ValueError(f"two modules have the name {name}: {found[0]} and {found[1]}")
    return found[0] if found else STATIC / name
