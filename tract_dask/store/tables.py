"""Tables that users bring, as programs and spreadsheets of any country write them."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

from ..errors import InputError, SettingsError

_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?|[-+]?(nan|inf|infinity)", re.IGNORECASE | re.ASCII)
_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?", re.ASCII)
_POINT = re.compile(r"[-+]?\d*\.\d+([eE][-+]?\d+)?", re.ASCII)


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes
    ----------
    header, line
        The names of its columns, and the line that they are in, counted from 1; empty and 1 where there is no line.
    rows
        Line and values of each row, as many as there are names; decimal commas are points.
    """

    header: list[str]
    line: int
    rows: list[tuple[int, list[str]]]


def decoded(data: bytes) -> str:
    """Return the text of a table in UTF-8 or, where it says so at its start, in UTF-16.

    Raises
    ------
    UnicodeDecodeError
        Where it is neither.
    """
    return data.decode("utf-16" if data[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8-sig")


def parse_number(text: str) -> float:
    """Return the number in a cell; what only Python reads as one, such as ``1_000``, is none.

    Raises
    ------
    ValueError
        Where it is none.
    """
    if not _NUMBER.fullmatch(text.strip()):
        raise ValueError(f"{text!r} is not a number")
    return float(text)


def parse_table(text: str, where: str, error: type[InputError] = SettingsError, most: int | None = None) -> Table:
    r"""Return a table whose values are separated by commas, semicolons or tabs, as its first line is.

    Empty lines and those that begin with ``#`` are skipped; a line ``sep=;`` before the first is understood. With
    semicolons and tabs numbers may have decimal commas.

    Parameters
    ----------
    text
        The table.
    where
        What to call it in errors.
    error
        What is raised.
    most
        Rows that are looked at; one more is returned where there are more.

    Raises
    ------
    InputError
        Naming the line: a row has more or fewer values than the first line names, a name comes twice, or numbers have
        points in one place and commas in another; and where it is not a table at all.

    Examples
    --------
    >>> parse_table("x;y\n1,5;2\n", "a.csv").rows
    [(2, ['1.5', '2'])]
    """
    split = re.split("\r\n|\r|\n", text.removeprefix("\ufeff"))
    lines = ["" if line.lstrip().startswith("#") else line for line in split]
    start, separator = _separator(lines)
    try:
        found = list(islice(_values(lines, start, separator), None if most is None else most + 2))
    except csv.Error as wrong:
        raise error("the table cannot be read", where, "a table in CSV", str(wrong), "Save it as CSV again") from wrong
    if not found:
        return Table([], 1, [])
    (line, header), rows = found[0], found[1:]
    _check_names(header, f"{where}, line {line}", error)
    rows = [(at, _fitted(values, header, f"{where}, line {at}", error)) for at, values in rows]
    return Table(header, line, _with_points(rows, where, error) if separator != "," else rows)


def _separator(lines: list[str]) -> tuple[int, str]:
    """Return where a table begins, and what separates its values."""
    start = next((k for k, line in enumerate(lines) if line.strip()), 0)
    first = lines[start] if lines else ""
    said = re.fullmatch(r'"?sep=(.)"?\s*', first)
    if said:
        return start + 1, said[1]
    bare = re.sub('"[^"]*"', "", first)
    return start, max(";\t,", key=bare.count) if re.search("[;\t,]", bare) else ","


def _values(lines: list[str], start: int, separator: str) -> Iterator[tuple[int, list[str]]]:
    reader = csv.reader(iter([f"{line}\n" for line in lines[start:]]), delimiter=separator, skipinitialspace=True)
    for row in reader:
        values = [value.strip() for value in row]
        if any(values) and not values[0].startswith("#"):
            yield start + reader.line_num, values


def _check_names(header: list[str], where: str, error: type[InputError]) -> None:
    twice = next((name for k, name in enumerate(header) if name and name in header[:k]), "")
    if twice:
        raise error("a name of the first line comes twice", where, "each name once", twice, "Rename one of the columns")


def _fitted(values: list[str], header: list[str], where: str, error: type[InputError]) -> list[str]:
    """Return a row as long as the header; what it has more may only be empty."""
    more = len(values) > len(header)
    if len(values) < len(header) or any(values[len(header) :]):
        raise error(
            f"there are {'more' if more else 'fewer'} values than the first line names",
            where,
            f"{len(header)} values: {', '.join(header)}",
            f"{len(values)}: {', '.join(values)}"[:200],
            "Write numbers with a point or separate values by semicolons, and write text with commas in quotes"
            if more
            else "Fill in what is missing",
        )
    return values[: len(header)]


def _with_points(rows: list[tuple[int, list[str]]], where: str, error: type[InputError]) -> list[tuple[int, list[str]]]:
    """Return rows whose decimal commas are points; a table has either."""
    commas = next((line for line, values in rows if any(map(_COMMA.fullmatch, values))), None)
    points = next((line for line, values in rows if any(map(_POINT.fullmatch, values))), None)
    if commas is None:
        return rows
    if points is not None:
        raise error(
            "numbers have commas in one place and points in another",
            f"{where}, line {max(commas, points)}",
            "either decimal commas or decimal points",
            f"a comma in line {commas}, a point in line {points}",
            "Write all of them with points",
        )
    return [
        (line, [value.replace(",", ".") if _COMMA.fullmatch(value) else value for value in values])
        for line, values in rows
    ]
