"""The tags of a DigitalMicrograph file: a tree of names, read without the pixels."""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, TypeAlias

import numpy as np

from ...errors import SourceError
from ..checks import open_binary, truncated

Tags: TypeAlias = dict[str, Any]
"""Tags by their names, entries without one by ``[0]``, ``[1]`` ...: numbers, text, an Array, or Tags again."""

_MOST_TAGS, _DEEPEST, _LONGEST_TEXT, _MOST_TYPES = 200_000, 64, 1 << 16, 1 << 12
"""More are a damaged file."""

_GROUP, _VALUE = 20, 21
_STRUCT, _TEXT, _ARRAY = 15, 18, 20
_NUMBERS = {2: "h", 3: "i", 4: "H", 5: "I", 6: "f", 7: "d", 8: "B", 9: "b", 10: "B", 11: "q", 12: "Q"}
_SIZES = {code: struct.calcsize(sign) for code, sign in _NUMBERS.items()}


@dataclass(frozen=True)
class Array:
    """Many values of one type.

    Attributes
    ----------
    offset, n_bytes
        Where they lie in the file.
    text
        What they say as UTF-16, where they are few and 2 bytes each.
    """

    offset: int
    n_bytes: int
    text: str = ""


@dataclass(frozen=True)
class TagFile:
    """The tags of a file.

    Attributes
    ----------
    version
        3 or 4.
    order
        Of bytes in values, ``<`` or ``>``.
    tags
        From the root on.
    end
        Where the last tag ends.
    lost
        The names of tags that are damaged and missing here.
    """

    version: int
    order: str
    tags: Tags
    end: int
    lost: tuple[str, ...] = ()


def read_tags(path: Path) -> TagFile:
    """Read the tags of a DM3 or DM4 file.

    Raises
    ------
    SourceError
        Where this is no such file, it ends too early, or its tags contradict it.
    """
    size = path.stat().st_size
    with open_binary(path) as file:
        start = file.read(16)
        version = int.from_bytes(start[:4], "big")
        order_at = {3: 8, 4: 12}.get(version)
        order = {0: ">", 1: "<"}.get(int.from_bytes(start[order_at : order_at + 4], "big")) if order_at else None
        if order_at is None or order is None or len(start) < order_at + 4:
            raise SourceError(
                "this is not a DigitalMicrograph file of version 3 or 4",
                str(path),
                "00 00 00 03 or 00 00 00 04 as its first bytes, and an order of bytes",
                start.hex(" "),
                "Check the copy; save files of other versions in DigitalMicrograph as .dm4",
            )
        file.seek(order_at + 4)
        walk = _Walk(file, str(path), size, order, wide=version == 4)
        tags = walk.group(0)
        return TagFile(version, order, tags, file.tell(), tuple(dict.fromkeys(walk.lost)))


class _Walk:
    """Goes along the tags of an open file."""

    def __init__(self, file: BinaryIO, where: str, size: int, order: str, *, wide: bool) -> None:
        self.file, self.where, self.size, self.order = file, where, size, order
        self.wide = wide
        self.word, self.word_bytes = (">Q", 8) if wide else (">I", 4)
        self.n_tags = 0
        self.lost: list[str] = []

    def group(self, depth: int) -> Tags:
        """Return the tags of the group that begins here."""
        if depth > _DEEPEST:
            raise self._damaged("the tags are nested too deeply", f"at most {_DEEPEST} groups in one another")
        self._take(2)  # whether sorted and open
        count = self._count()
        if count > self.size:  # a tag takes more than a byte
            raise self._damaged("a group claims more tags than the file has bytes", f"at most {self.size:,}", count)
        found: Tags = {}
        unnamed = 0
        for _ in range(count):
            kind, length = struct.unpack(">BH", self._take(3))
            name = self._take(length).decode("latin-1")
            if not name:
                name, unnamed = f"[{unnamed}]", unnamed + 1
            n_bytes = struct.unpack(">Q", self._take(8))[0] if self.wide else self.size
            found.setdefault(name, self._content_or_none(kind, depth, name, self.file.tell() + n_bytes))
        return found

    def _content_or_none(self, kind: int, depth: int, name: str, end: int) -> Any:
        """Return the content of a tag; None, and go to its end, where it is damaged but its length is known."""
        try:
            return self._content(kind, depth)
        except SourceError:
            if end > self.size or self.n_tags > _MOST_TAGS:
                raise
            self.lost.append(name)
            self.file.seek(end)
            return None

    def _content(self, kind: int, depth: int) -> Any:
        self.n_tags += 1
        if self.n_tags > _MOST_TAGS:
            raise self._damaged("the file has too many tags", f"at most {_MOST_TAGS:,}")
        if kind == _GROUP:
            return self.group(depth + 1)
        if kind != _VALUE:
            raise self._damaged("a tag is neither a group nor a value", f"{_GROUP} or {_VALUE}", kind)
        if self._take(4) != b"%%%%":
            raise self._damaged("a value does not begin as values do", "%%%%")
        n_types = self._count()
        if not 1 <= n_types <= _MOST_TYPES:
            raise self._damaged("a value has an impossible type", f"1 to {_MOST_TYPES:,} words", n_types)
        words = struct.unpack(f">{n_types}{self.word[1]}", self._take(n_types * self.word_bytes))
        return self._value(words)

    def _value(self, words: tuple[int, ...]) -> Any:
        kind = words[0]
        if kind in _NUMBERS and len(words) == 1:
            found = struct.unpack(self.order + _NUMBERS[kind], self._take(_SIZES[kind]))[0]
            return short(found) if _NUMBERS[kind] == "f" else found
        if kind == _STRUCT:
            fields = "".join(self._fields(words))
            return struct.unpack(self.order + fields, self._take(struct.calcsize("=" + fields)))
        if kind == _TEXT and len(words) == 2:
            return self._array(2 * words[1], text=True)
        if kind == _ARRAY and len(words) >= 3:
            size, text = self._element(words[1:-1]), words[1:-1] == (4,)
            return self._array(size * words[-1], text=text)
        raise self._damaged("a value has an unknown type", "a number, text, a structure or an array", words[:9])

    def _element(self, words: tuple[int, ...]) -> int:
        """Return the bytes of an element of an array."""
        if words[0] == _STRUCT:
            return struct.calcsize("=" + "".join(self._fields(words)))
        if words[0] in _SIZES and len(words) == 1:
            return _SIZES[words[0]]
        raise self._damaged("an array has elements of an unknown type", "numbers or structures", words[:9])

    def _fields(self, words: tuple[int, ...]) -> Iterator[str]:
        """Yield the types of a structure's fields, for struct."""
        kinds = words[4::2]
        if len(words) < 3 or len(kinds) != words[2] or len(words) != 3 + 2 * words[2]:
            raise self._damaged("a structure contradicts its number of fields", "a name and a type a field", words[:9])
        for kind in kinds:
            if kind not in _NUMBERS:
                raise self._damaged("a structure has a field of an unknown type", "numbers", kind)
            yield _NUMBERS[kind]

    def _array(self, n_bytes: int, *, text: bool) -> Array:
        """Return an array that begins here, and go to its end."""
        offset = self.file.tell()
        if offset + n_bytes > self.size:
            raise truncated(self.where, "in its pixels or another array of its tags", offset + n_bytes, self.size)
        if not text or n_bytes > _LONGEST_TEXT:
            self.file.seek(n_bytes, 1)
            return Array(offset, n_bytes)
        encoding = "utf-16-le" if self.order == "<" else "utf-16-be"
        return Array(offset, n_bytes, self._take(n_bytes).decode(encoding, "replace").rstrip("\0"))

    def _count(self) -> int:
        number: int = struct.unpack(self.word, self._take(self.word_bytes))[0]
        return number

    def _take(self, count: int) -> bytes:
        found = self.file.read(count)
        if len(found) < count:
            raise truncated(self.where, "within its tags", self.file.tell() + count - len(found), self.size)
        return found

    def _damaged(self, what: str, expected: str, got: object = "") -> SourceError:
        place = f"byte {self.file.tell():,}"
        got = f"{got} at {place}" if got != "" else f"more at {place}"
        return SourceError(what, self.where, expected, got, "The file is damaged: make the copy or the export again")


def short(value: float) -> float:
    """Return a number that was stored in single precision with the digits that it was written with.

    Examples
    --------
    >>> short(0.019999999552965164), short(float("inf"))
    (0.02, inf)
    """
    return float(str(np.float32(value)))


def below(tags: object, *names: str) -> Tags:
    """Return the group at a path of names; empty where there is none."""
    found = value(tags, *names)
    return found if isinstance(found, dict) else {}


def value(tags: object, *names: str) -> object:
    """Return what is at a path of names; None where there is nothing."""
    for name in names:
        tags = tags.get(name) if isinstance(tags, dict) else None
    return tags


def number(tags: object, *names: str) -> float | None:
    """Return the number at a path of names; None where there is none."""
    found = value(tags, *names)
    return found if isinstance(found, int | float) and not isinstance(found, bool) else None


def text(tags: object, *names: str) -> str:
    """Return the text at a path of names; empty where there is none."""
    found = value(tags, *names)
    words = found.text if isinstance(found, Array) else found
    return words if isinstance(words, str) else ""


def entries(tags: object, *names: str) -> list[tuple[int, Any]]:
    """Return the numbered entries at a path of names, in order: ``[0]``, ``[1]`` ...

    Examples
    --------
    >>> entries({"Dimensions": {"[1]": 64, "[0]": 128}}, "Dimensions")
    [(0, 128), (1, 64)]
    """
    numbered = ((re.fullmatch(r"\[(\d{1,9})\]", name), entry) for name, entry in below(tags, *names).items())
    return sorted(((int(match[1]), entry) for match, entry in numbered if match), key=lambda item: item[0])


def flat(tags: Tags, path: str = "") -> Iterator[tuple[str, object]]:
    """Yield every value with its path, such as ``DataBar/Exposure Time (s)``."""
    for name, entry in tags.items():
        if isinstance(entry, dict):
            yield from flat(entry, f"{path}{name}/")
        else:
            yield path + name, entry
