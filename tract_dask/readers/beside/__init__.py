"""What small text files beside a movie say of it: SerialEM's .mdoc, and Direct Electron's _info.txt."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from ...errors import SourceError
from ..checks import Permit, checked_file, is_named, lies_there
from ..source import NOTHING_KNOWN, SourceMetadata
from . import direct_electron, mdoc

_MOST_BYTES = 64 << 20
"""A text file of headers is no longer; 100,000 sections of SerialEM take half of it."""


def known_beside(path: Path, n_frames: int, permit: Permit | None) -> SourceMetadata:
    """Return what the text files beside a movie say of its ``n_frames`` frames.

    Raises
    ------
    SourceError
        Where there is such a file and it cannot be read.
    """
    known = NOTHING_KNOWN
    for file in _mdoc_names(path):
        if lies_there(file, permit):
            known = _found(mdoc.parse(_text(file, permit), n_frames, file.name), path)
            break
    for file in _info_names(path):
        if lies_there(file, permit):
            known = merged(known, direct_electron.parse(_text(file, permit), path.stem, n_frames, file.name), file.name)
            break
    return known


def info_text(path: Path, permit: Permit | None) -> str:
    """Return the text of Direct Electron's file beside a movie; empty where there is none."""
    return next((_text(file, permit) for file in _info_names(path) if lies_there(file, permit)), "")


def merged(first: SourceMetadata, second: SourceMetadata, where: str) -> SourceMetadata:
    """Return what two places say of a movie; where they contradict each other, the first, and a note.

    Parameters
    ----------
    first, second
        What each says.
    where
        The name of the second place.
    """
    notes = (*first.notes, *(note for note in second.notes if note not in first.notes))
    for name, unit in (("pixel_size_pm", "pm"), ("frame_time_s", "s"), ("dose", "e/A^2")):
        here, there = getattr(first, name), getattr(second, name)
        if here and there and not math.isclose(here, there, rel_tol=0.01):
            words = name.rsplit("_", 1)[0].replace("_", " ")
            notes += (f"{where} gives a {words} of {there:.6g} {unit}, the movie {here:.6g} {unit}, which is used",)
    return replace(
        first,
        pixel_size_pm=first.pixel_size_pm or second.pixel_size_pm,
        frame_time_s=first.frame_time_s or second.frame_time_s,
        dose=first.dose or second.dose,
        notes=notes,
        along_frames={**second.along_frames, **first.along_frames},
        references={**second.references, **first.references},
        start_s=second.start_s if first.start_s is None else first.start_s,
    )


def _found(known: SourceMetadata, path: Path) -> SourceMetadata:
    """Return what is known with the references that lie beside the movie, and a note on each that frames lack."""
    named = {kind: path.with_name(name.name) for kind, name in known.references.items()}
    found = {kind: file for kind, file in named.items() if is_named(file)}
    notes = tuple(
        f"{path.name}: the camera's {kind} reference was not applied; it is {file.name},"
        f" which {'lies next to it' if kind in found else 'is not there'}"
        for kind, file in named.items()
    )
    return replace(known, references=found, notes=(*known.notes, *notes))


def _mdoc_names(path: Path) -> tuple[Path, ...]:
    return path.with_name(f"{path.name}.mdoc"), path.with_suffix(".mdoc")


def _info_names(path: Path) -> Iterator[Path]:
    """Return where Direct Electron's file may be: the acquisition's name, which the movie's begins with, and _info."""
    parts = path.stem.split("_")
    for count in range(len(parts), 0, -1):
        yield path.with_name(f"{'_'.join(parts[:count])}_info.txt")


def _text(file: Path, permit: Permit | None) -> str:
    size = checked_file(file, permit).st_size
    if size > _MOST_BYTES:
        raise SourceError(
            "the text file next to the movie is far too long",
            str(file),
            f"at most {_MOST_BYTES:,} bytes",
            f"{size:,} bytes",
            "Move it away: the movie opens without it",
        )
    return file.read_bytes().decode("utf-8-sig", "replace")
