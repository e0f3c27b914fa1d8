"""What the names of a folder's files say: their order, and what a person would not take for frames of one movie."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from decimal import Decimal
from itertools import pairwise
from pathlib import PurePath
from typing import TypeAlias

Part: TypeAlias = tuple[int, Decimal, str]
"""A piece of a name: a number, or the text between two."""

_FRACTION = r"(?<![\d.,])\d+[.,]\d+(?![.,]?\d)"
_WORDS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])")
_WORD_COPY = "(copy|kopie|copie|copia)"
_COPY = re.compile(rf"(?i)( \(\d+\)|[ _-]+{_WORD_COPY}( ?\(?\d+\)?)?|~)$|^{_WORD_COPY} (of|von|de) ")

_REFERENCES = {"gain": "gain", "flat": "gain", "dark": "dark", "background": "dark", "defect": "defects"}
_REFERENCES |= {"badpix": "defects", "bkg": "dark"}
_FEW = 3
"""So few files may be references beside as few frames."""


def in_order(names: Sequence[str]) -> list[str]:
    """Return names in the order of the numbers in them, which may have decimals and signs.

    Examples
    --------
    >>> in_order(["frame_10.tif", "frame_2.tif"])
    ['frame_2.tif', 'frame_10.tif']
    >>> in_order(["t_0.1s.tif", "t_0.05s.tif", "t_1s.tif", "t_-0.5s.tif"])
    ['t_-0.5s.tif', 't_0.05s.tif', 't_0.1s.tif', 't_1s.tif']
    >>> in_order(["scan_1.10.tif", "scan_1.9.tif"])  # 1.10 is no decimal number
    ['scan_1.9.tif', 'scan_1.10.tif']
    """
    rule = _rule(names)
    return sorted(names, key=lambda name: (_parts(name, rule), name))


def notes_on(names: Sequence[str]) -> tuple[str, ...]:
    """Return notes on names, in their order, that are not simply those of one movie's files.

    Examples
    --------
    >>> notes_on(["f_1.tif", "f_2.tif", "f_5.tif"])
    ('the sequence has a gap in its numbers: f_5.tif follows f_2.tif; the frames are read without one for the gap',)
    >>> notes_on(["f_1.tif", "f_2 (1).tif", "f_2.tif"])
    ('f_2 (1).tif looks like a copy of f_2.tif; both are read as frames',)
    >>> notes_on(["a_1.tif", "a_2.tif", "b_1.tif", "b_2.tif"])
    ('the names are of several kinds, read one after the other: a_1.tif (2 files), b_1.tif (2 files)',)
    """
    rule = _rule(names)
    copies = _copies(names)
    plain = [name for name in names if name not in copies]
    kinds: dict[str, list[str]] = {}
    for name in plain:
        kinds.setdefault(_kind(name, rule), []).append(name)
    largest = max(kinds.values(), key=len)
    return (
        _decimals(names, rule)
        + _powers(names)
        + _dates(names)
        + _twice(plain, rule)
        + _copied(copies)
        + _several(kinds)
        + _series(largest, rule)
        + gaps(largest)
    )


def references(names: Sequence[str]) -> dict[str, str]:
    """Return which files are references of the detector and what they are, where others are the movie.

    Examples
    --------
    >>> references(["frame_1.tif", "frame_2.tif", "gain_ref.tif"])
    {'gain_ref.tif': 'gain'}
    >>> references(["dark_1.tif", "dark_2.tif"])
    {}
    """
    found = {name: kind for name in names if (kind := _reference(name))}
    n_others = len(names) - len(found)
    return found if n_others and (len(found) <= _FEW or 2 * len(found) < n_others) else {}


def gaps(names: Sequence[str]) -> tuple[str, ...]:
    """Return a note on the numbers that are missing from a sorted sequence of names; none where they do not count up.

    Examples
    --------
    >>> gaps(["f_001.tif", "f_002.tif", "f_005.tif"])
    ('the sequence has a gap in its numbers: f_005.tif follows f_002.tif; the frames are read without one for the gap',)
    """
    varying = _varying(names, _rule(names))
    if len(varying) != 1:
        return ()
    steps = [after - before for before, after in pairwise(varying[0])]
    growing = [step for step in steps if step > 0]
    if not growing:
        return ()
    usual = min(growing)
    limit = usual if all(step == int(step) for step in growing) else usual * Decimal("1.5")  # times are rounded
    wide = [number for number, step in enumerate(steps) if step > limit]
    if not wide:
        return ()
    more = f" (and {len(wide) - 1} more)" if len(wide) > 1 else ""
    return (
        f"the sequence has a gap in its numbers: {names[wide[0] + 1]} follows {names[wide[0]]}{more};"
        " the frames are read without one for the gap",
    )


def _rule(names: Sequence[str]) -> re.Pattern[str]:
    """Return what a number is in these names: with decimals or not, a hyphen behind a letter its sign or not."""
    number = rf"{_FRACTION}|\d+" if _are_decimals(names) else r"\d+"
    signed = re.compile(rf"(?:(?<!\d)[-+])?(?:{number})")
    free = re.compile(rf"(?:(?<![^\W_])[-+])?(?:{number})")
    with_sign = {_kind(name, signed) for name in names}
    without = {_kind(name, free) for name in names}
    return signed if len(with_sign) < len(without) else free


def _are_decimals(names: Sequence[str]) -> bool:
    """Tell whether a point between digits is a decimal one: not in 1.9, 1.10, which count up."""
    behind = [re.split("[.,]", found)[1] for name in names for found in re.findall(_FRACTION, _stem(name))]
    shortest = min(map(len, behind), default=0)
    if any(digits.startswith("0") and len(digits) > 1 for digits in behind):
        return True
    return not any(digits.endswith("0") and len(digits) > shortest for digits in behind)


def _stem(name: str) -> str:
    return name[: len(name) - len(PurePath(name).suffix)]


def _parts(name: str, rule: re.Pattern[str]) -> tuple[Part, ...]:
    """Return the pieces of a name: text sorts before numbers."""
    stem, at, parts = _stem(name), 0, []
    for found in rule.finditer(stem):
        parts += [(0, Decimal(0), stem[at : found.start()]), (1, Decimal(found[0].replace(",", ".")), "")]
        at = found.end()
    return (*parts, (0, Decimal(0), stem[at:]))


def _kind(name: str, rule: re.Pattern[str]) -> str:
    return rule.sub("#", _stem(name))


def _varying(names: Sequence[str], rule: re.Pattern[str]) -> list[tuple[Decimal, ...]]:
    """Return the numbers that differ from name to name, each with its values; none where the names are of two kinds."""
    if len({_kind(name, rule) for name in names}) != 1:
        return []
    fields = zip(*([number for is_number, number, _ in _parts(name, rule) if is_number] for name in names), strict=True)
    return [field for field in fields if len(set(field)) > 1]


def _decimals(names: Sequence[str], rule: re.Pattern[str]) -> tuple[str, ...]:
    """Return a note where it matters whether points are decimal ones."""
    whole = re.compile(r"\d+")
    if sorted(names, key=lambda name: _parts(name, rule)) == sorted(names, key=lambda name: _parts(name, whole)):
        return ()
    return ("the numbers in the names are taken with their signs and decimals, and the frames are in their order",)


_POWER = re.compile(r"(?<![^\W_])\d+(?:[.,]\d+)?[eE][-+]\d{1,2}(?!\d)")


def _powers(names: Sequence[str]) -> tuple[str, ...]:
    """Return a note where names hold numbers with a power of ten, by which they are not ordered."""
    found = next((match[0] for name in names if (match := _POWER.search(_stem(name)))), None)
    if found is None or len(names) < 2:
        return ()
    return (
        f"the names hold numbers such as {found}, which are not taken for powers of ten: check the order of the frames,"
        " or give the files as a list",
    )


_DATE = re.compile(r"(?<!\d)(\d{1,2})[-._](\d{1,2})[-._](?:19|20)\d\d(?!\d)")


def _dates(names: Sequence[str]) -> tuple[str, ...]:
    """Return a note where names hold dates that differ, with the year last: they are not ordered by them."""
    found = {match[0] for name in names if (match := _DATE.search(_stem(name)))}
    if len(found) < 2:
        return ()
    return (
        f"the names hold dates such as {min(found)}, with the year last, by which they are not ordered: check the order"
        " of the frames, or give the files as a list",
    )


def _twice(names: Sequence[str], rule: re.Pattern[str]) -> tuple[str, ...]:
    """Return a note where two names in their order differ in the spelling of numbers only, such as 1 and 01."""
    same = [pair for pair in pairwise(names) if _parts(pair[0], rule) == _parts(pair[1], rule)]
    if not same:
        return ()
    more = f" (and {len(same) - 1} more)" if len(same) > 1 else ""
    return (f"{same[0][0]} and {same[0][1]} have the same numbers{more}; both are read as frames",)


def _copies(names: Sequence[str]) -> dict[str, str]:
    """Return which names only differ by a mark of copies from another one."""
    there = {name.lower(): name for name in names}
    plain = {name: _COPY.sub("", _stem(name)) + PurePath(name).suffix for name in names}
    return {name: there[other.lower()] for name, other in plain.items() if other != name and other.lower() in there}


def _copied(copies: dict[str, str]) -> tuple[str, ...]:
    if not copies:
        return ()
    copy, original = next(iter(copies.items()))
    more = f" (and {len(copies) - 1} more)" if len(copies) > 1 else ""
    return (f"{copy} looks like a copy of {original}{more}; both are read as frames",)


def _several(kinds: dict[str, list[str]]) -> tuple[str, ...]:
    if len(kinds) < 2:
        return ()
    shown = ", ".join(f"{names[0]} ({len(names)} file{'s' * (len(names) > 1)})" for names in list(kinds.values())[:4])
    more = f" and {len(kinds) - 4} more" if len(kinds) > 4 else ""
    return (f"the names are of several kinds, read one after the other: {shown}{more}",)


def _series(names: list[str], rule: re.Pattern[str]) -> tuple[str, ...]:
    """Return a note where the last number begins anew for each value of one before it: several series."""
    varying = _varying(names, rule)
    if len(varying) != 2:
        return ()
    firsts: dict[Decimal, list[Decimal]] = {}
    for series, number in zip(varying[0], varying[1], strict=True):
        firsts.setdefault(series, []).append(number)
    starts = Counter(min(numbers) for numbers in firsts.values())
    if len(firsts) == len(names) or len(starts) > 1:
        return ()
    second = names[len(next(iter(firsts.values())))]
    return (f"the names are of {len(firsts)} series, read one after the other: the second begins with {second}",)


def _reference(name: str) -> str:
    """Return what kind of reference a name says that a file is; empty for frames, also those in dark field."""
    words = [word.lower() for word in _WORDS.findall(_stem(name))]
    for word, after in pairwise([*words, ""]):
        kind = next((kind for start, kind in _REFERENCES.items() if word.startswith(start)), "")
        if kind and "field" not in (word.removeprefix("dark"), after if word == "dark" else ""):
            return kind
    return "gain" if {"ref", "reference"} & set(words) else ""
