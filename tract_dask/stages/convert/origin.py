"""Where a movie comes from: the source's content, and whether a store was made of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np

from ...errors import DestinationError, MissingSourceError, SourceError
from ...readers.checks import reading
from ...readers.source import FrameSource, Source, SourceMetadata
from ...settings.run import ConvertSettings, MetadataSettings, SourceSettings
from ...store import metadata
from ...store.keys import ALGORITHMS, counted, default_of, digest_of, stage_key
from ...store.layout import plan_layout
from ...store.movie import check_known
from ...store.provenance import fingerprint
from ...store.stamps import Stamps
from . import references
from .create import quantities

DEFAULT_LAYOUT = ConvertSettings()

STAGE = "convert"

AS_THE_FILE_SAYS = MetadataSettings()

DECLARED_NOTHING = SourceSettings()


@dataclass(frozen=True)
class Origin:
    """What a movie is made from, as it was when it was first looked at.

    Attributes
    ----------
    stamps
        What the system said of the files.
    content
        A hash of what they hold, whatever their names, folders and times.
    """

    stamps: Stamps
    content: str


_origins: WeakKeyDictionary[FrameSource, Origin] = WeakKeyDictionary()


def origin_of(source: FrameSource) -> Origin:
    """Return the origin of an opened source; it is looked at once.

    Raises
    ------
    SourceError
        Where a file cannot be read.
    """
    if source not in _origins:
        with reading(source.path):
            stamps = Stamps.of(source.files)  # first: a change meanwhile has to be noticed later
            _origins[source] = Origin(stamps, content_of(source))
    return _origins[source]


def content_of(source: FrameSource) -> str:
    """Return a hash of what a source holds."""
    if isinstance(source, GoneSource):
        return source.content
    return digest_of(source.inside, fingerprint(*source.files))


def movie_key(
    source: FrameSource,
    settings: ConvertSettings = DEFAULT_LAYOUT,
    source_settings: SourceSettings = DECLARED_NOTHING,
) -> str:
    """Return the key of the movie that :func:`convert` makes; pixel size, times, dose and gain are not part of it."""
    return stage_key(STAGE, origin_of(source).content, counted_of(source, settings, source_settings))


def counted_of(
    source: FrameSource,
    settings: ConvertSettings,
    source_settings: SourceSettings,
    remembered: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Return the settings of a movie's key that differ from their defaults, by their names in keys.

    References count by what they hold. Where the source is gone, and they too, what the movie's attributes say of
    them, ``remembered``, does.
    """
    known = remembered if isinstance(source, GoneSource) else None
    own = counted(STAGE, convert=settings, source=source_settings)
    return own | references.contents(settings, source.permit, known)


def made_of(source: FrameSource, settings: ConvertSettings, source_settings: SourceSettings) -> dict[str, Any]:
    """Return what a movie's key is made of, by which the movie is known again without its source."""
    origin = origin_of(source)
    made = {
        "content": origin.content,
        "algorithm": ALGORITHMS[STAGE],
        "settings": counted_of(source, settings, source_settings),
    }
    return {"made": made, "written": origin.stamps.written}


def is_converted(path: Path, source: FrameSource, settings: ConvertSettings, source_settings: SourceSettings) -> bool:
    """Tell whether the movie at ``path`` is complete, and what :func:`convert` would make."""
    present = metadata.attributes(path)
    whole = present.get("kind") == "movie" and bool(present.get("complete"))
    if whole:
        check_known(path, present)
    return whole and not _differences(present, source, settings, source_settings)


def is_movie_of(path: Path, source: FrameSource) -> bool:
    """Tell whether the store at ``path``, complete or not, was made from what ``source`` holds."""
    present = metadata.attributes(path)
    return bool(present) and present.get("made", {}).get("content") == origin_of(source).content


def check_kept(path: Path, source: FrameSource, settings: ConvertSettings, source_settings: SourceSettings) -> None:
    """Check that making the movie at ``path`` would throw no other complete one away.

    Raises
    ------
    DestinationError
        Saying what differs, old and new, and what would be made again.
    """
    present = metadata.attributes(path)
    if not present or (present.get("kind") == "movie" and not present.get("complete")):
        return
    if present.get("kind") != "movie" or not is_movie_of(path, source):
        raise DestinationError(
            "this store was made from something else",
            str(path),
            f"nothing, or a movie made from what {source.path} holds now",
            f"a store made from {present.get('source') or 'an unknown source'}",
            "Choose another place, or use --overwrite",
        )
    if found := _differences(present, source, settings, source_settings):
        frames, *sides = present["shape"]
        raise DestinationError(
            "this movie was converted otherwise",
            str(path),
            "the settings and the version that made it",
            "; ".join(found),
            "Use those, choose another place, or use --overwrite: then its"
            f" {frames} frames of {sides[0]} x {sides[1]} px are converted again from {source.path},"
            " and drift, sum and tracks are made again",
        )


_LAID_OUT = ("convert.shard_mb", "convert.tile_px")
"""Settings that count by the layout that comes of them."""


def _differences(
    present: dict[str, Any], source: FrameSource, settings: ConvertSettings, source_settings: SourceSettings
) -> list[str]:
    """Return in words how a complete movie differs from what would be made; nothing where it does not."""
    made = present.get("made", {})
    then = made.get("settings", {})
    now = counted_of(source, settings, source_settings, present)
    layout = plan_layout(source.shape, source.dtype, settings)
    laid = [layout.frames_per_shard, list(layout.chunk)] == [present.get("frames_per_shard"), present.get("chunk")]
    found = [] if made.get("content") == origin_of(source).content else ["the source has other content"]
    if made.get("algorithm") != ALGORITHMS[STAGE]:
        found.append(f"its conversion's number was {made.get('algorithm')}, and is {ALGORITHMS[STAGE]}")
    for name in sorted({*then, *now} - {*(_LAID_OUT if laid else ())}):
        old, new = (values.get(name, default_of(STAGE, name)) for values in (then, now))
        if old != new and name.removeprefix("convert.") in references.NAMES:
            found.append(references.difference_in_words(name, old, new))
        elif old != new:
            found.append(f"{name} was {_in_words(old)}, and is {_in_words(new)}")
    return found


def _in_words(value: Any) -> str:
    return "unset" if value is None else f"{value:g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True, kw_only=True, eq=False)
class GoneSource(Source):
    """A source that is not there any more, as the movie remembers it that was made from it; it has no frames to read.

    Attributes
    ----------
    content
        A hash of what it held.
    """

    content: str


def remembered_source(path: Path, source: str, error: SourceError) -> GoneSource | None:
    """Return the source of the complete movie at ``path``, which is not there; None where it is, or is another.

    Parameters
    ----------
    source
        Where it should be. It has the name that it had, in any folder.
    error
        Why it cannot be opened.
    """
    present = metadata.attributes(path)
    known = present.get("complete") and present.get("made") and _name(present["source"]) == _name(source)
    if not known or not (isinstance(error, MissingSourceError) or _is_out_of_reach(source)):
        return None
    note = f"{source} is not there: the run goes on with the movie that was converted from it"
    return GoneSource(
        path=source,
        files=(),
        format=present["source_format"],
        shape=tuple(present["shape"]),
        dtype=np.dtype(present["dtype"]),
        metadata=SourceMetadata(**present["file_says"], notes=(note,)),
        content=present["made"]["content"],
    )


def _name(source: str) -> tuple[str, str]:
    """Return the name of a source without its folder, and the path inside it."""
    outer, _, inner = source.partition("::")
    return Path(outer).name, inner


def _is_out_of_reach(source: str) -> bool:
    """Tell whether the system does not even say what is at a source's path, as where a mount has gone."""
    try:
        Path(source.partition("::")[0]).stat()
    except FileNotFoundError:
        return False  # a pattern, or the reader knows better
    except OSError:
        return True
    return False


def remembered(source: FrameSource) -> dict[str, Any]:
    """Return what a movie remembers of a source that is there."""
    if isinstance(source, GoneSource):
        return {}
    return {
        "source": absolute(source.path),
        "source_files": list(map(absolute, source.listed)),
        "source_format": source.format,
        "file_says": quantities(source.metadata),
    }


def absolute(source: str) -> str:
    """Return the source's path as any worker can use it, whatever folder it runs in."""
    outer, inside, inner = source.partition("::")
    return f"{Path(outer).absolute()}{inside}{inner}"
