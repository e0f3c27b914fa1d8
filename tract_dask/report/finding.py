"""One finding of a report, and the numbers in its sentences."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

_NAMED = 10


@dataclass(frozen=True)
class Finding:
    """Something to know.

    Attributes
    ----------
    name
        What kind of finding it is.
    title
        In a few words.
    text
        With its numbers.
    remedy
        What can be done.
    serious
        Whether it is a warning; otherwise it is only good to know.
    """

    name: str
    title: str
    text: str
    remedy: str = ""
    serious: bool = True


def named(numbers: Iterable[int | str]) -> str:
    """Return numbers for a sentence, the first few of them.

    Examples
    --------
    >>> named([3, 4, 9]), named([7]), named(range(12))
    ('3, 4 and 9', '7', '0, 1, 2, 3, 4, 5, 6, 7, 8, 9 and 2 more')
    """
    every = [str(number) for number in numbers]
    first, rest = every[:_NAMED], every[_NAMED:]
    last = f"{len(rest)} more" if rest else first.pop() if first else ""
    return f"{', '.join(first)} and {last}" if first else last


def count(number: int, what: str) -> str:
    """Return a number of things, in the singular or the plural.

    Examples
    --------
    >>> count(1, "frame"), count(12_000, "frame")
    ('1 frame', '12,000 frames')
    """
    return f"{number:,} {what}{'' if number == 1 else 's'}"
