"""Tables of what was measured, and their place in a document."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..report import table


@dataclass(frozen=True)
class Table:
    """A caption, a head and rows of cells, as text."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        """Return the table as Markdown, its caption above it."""
        return f"{self.caption}\n\n{table(self.head, self.rows)}"


def with_error(value: float, error: float, digits: int = 2) -> str:
    """Return a value and its standard error.

    Examples
    --------
    >>> with_error(4.837, 0.119)
    '4.84 ± 0.12'
    """
    return f"{value:.{digits}f} ± {error:.{digits}f}"


def markers(section: str) -> tuple[str, str]:
    """Return the comments between which a section's tables stand in a document."""
    return f"<!-- {section}: written by benchmarks.science -->", f"<!-- end of {section} -->"


def publish(section: str, text: str, document: Path) -> None:
    """Replace the tables of a section in a document.

    Raises
    ------
    ValueError
        Where the document has no place for them.
    """
    begin, end = markers(section)
    before, found, rest = document.read_text(encoding="utf-8").partition(begin)
    _, ended, after = rest.partition(end)
    if not (found and ended):
        raise ValueError(f"{document} has no lines {begin!r} and {end!r}")
    document.write_text(f"{before}{begin}\n\n{text}\n\n{end}{after}", encoding="utf-8")


def markdown(tables: Iterable[Table]) -> str:
    """Return tables as Markdown, one after another."""
    return "\n\n".join(one.markdown() for one in tables)
