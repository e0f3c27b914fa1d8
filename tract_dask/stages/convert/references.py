"""What the references of a detector make of recorded pixels: (pixel - dark) / sensitivity, and faulty ones left out.

A gain reference that is multiplied holds 1 / sensitivity, one that is divided (a flat field) the sensitivity itself.
Both are scaled so that the mean sensitivity is 1: frames that are lit evenly keep their mean.
"""

from __future__ import annotations

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import MissingSourceError, SettingsError, SourceError
from ...kernels.defects import USER
from ...readers.checks import Permit
from ...readers.source import FrameSource
from ...settings.declare import option
from ...settings.run import ConvertSettings, MetadataSettings
from ...settings.toml import from_toml
from ...store.keys import digest_of
from ...store.pixels import NO_PIXELS, Pixels
from .reference_files import check_reference, content_of_reference, in_part, read_defects, read_reference

NAMES = ("dark", "gain_reference", "defects")
"""The settings that name references."""

_MOST = 0.5
"""References that leave out a larger share of the pixels are refused."""

_UNLIKE = 4.0
"""A pixel whose sensitivity differs so many times from the usual one is faulty."""


def given(settings: ConvertSettings) -> dict[str, str]:
    """Return where the references are that the settings name, by the settings' names."""
    named = {name: getattr(settings, name) for name in NAMES}
    return {name: place for name, place in named.items() if place is not None}


def applied_by(settings: ConvertSettings) -> list[str]:
    """Return the options of the references that are given."""
    return [option("convert", field) for field in fields(settings) if field.name in given(settings)]


def with_whole_paths(settings: ConvertSettings) -> ConvertSettings:
    """Return the settings with whole paths of the references, so that they mean the same from any folder."""
    whole: dict[str, Any] = {name: str(Path(place).absolute()) for name, place in given(settings).items()}
    return replace(settings, **whole)


def contents(
    settings: ConvertSettings, permit: Permit | None = None, remembered: dict[str, Any] | None = None
) -> dict[str, str]:
    """Return what the references hold, by the names in keys; where one is gone, what is ``remembered`` of it.

    Parameters
    ----------
    settings
        Where they are.
    remembered
        What a movie's attributes say: it knows what references held whose files had these names.

    Raises
    ------
    SourceError
        Where one cannot be read.
    """
    found, known = {}, {}
    if remembered:
        made, then = remembered["made"]["settings"], from_toml(ConvertSettings, remembered["settings"], "")
        known = {(name, _without_folder(place)): made.get(f"convert.{name}") for name, place in given(then).items()}
    for name, place in given(settings).items():
        try:
            found[f"convert.{name}"] = digest_of(*content_of_reference(place, permit))
        except MissingSourceError:
            if not (content := known.get((name, _without_folder(place)))):
                raise
            found[f"convert.{name}"] = str(content)
    return found


def _without_folder(place: str) -> tuple[str, str]:
    outer, _, inner = place.partition("::")
    return Path(outer).name, inner


def difference_in_words(name: str, old: Any, new: Any) -> str:
    """Return how a reference, by its name in keys, differs from the one before, by what both hold; None: not given.

    Examples
    --------
    >>> difference_in_words("convert.dark", None, "5f2c")
    'convert.dark was not given, and is now'
    """
    if old and new:
        return f"{name} has other contents than before"
    return f"{name} was {'given, and is not now' if old else 'not given, and is now'}"


def check_references(movie: FrameSource, settings: ConvertSettings, metadata: MetadataSettings) -> None:
    """Check that references are there and fit the frames of a source that is there, before any work.

    Raises
    ------
    SourceError
        Where one does not.
    SettingsError
        Where an offset is given beside a dark image, which holds it, or beside a gain reference without one.
    """
    for name, place in given(settings).items() if movie.files else ():
        check_reference(place, movie, may_be_list=name == "defects")
    if isinstance(metadata.offset, str) or metadata.offset == 0:
        return
    if settings.dark is not None or settings.gain_reference is not None:
        what, remedy = (
            ("the dark image holds the offset already", "Leave out --offset, or --dark")
            if settings.dark is not None
            else ("a gain reference is for pixels without an offset", "Give the offset as a dark image (--dark)")
        )
        raise SettingsError(
            what, "setting offset (MetadataSettings)", "0 or auto with references", f"{metadata.offset:g}", remedy
        )


def read_references(movie: FrameSource, settings: ConvertSettings) -> Pixels:
    """Return what corrects the frames of a movie, as its store keeps it: ``dark``, ``gain`` and a ``mask``.

    Raises
    ------
    SourceError
        Where a reference cannot be read, has another shape, or holds nothing that corrects a pixel.
    """
    if not given(settings):
        return NO_PIXELS
    faulty = np.zeros(movie.shape[1:], bool)
    dark = gain = None
    if settings.defects is not None:
        faulty |= in_part(read_defects(settings.defects, movie), movie).any(axis=2)
    if settings.dark is not None:
        level = in_part(read_reference(settings.dark, movie), movie).sum(axis=2)
        unknown = ~np.isfinite(level)
        _check_share(unknown, settings.dark, "the dark image holds no numbers at most pixels", "numbers")
        faulty |= unknown
        dark = np.where(np.isfinite(level), level, 0).astype(np.float32)
    if settings.gain_reference is not None:
        image = read_reference(settings.gain_reference, movie)
        found = in_part(sensitivity(image, settings.gain_reference, settings.gain_reference_by), movie)
        faulty |= np.isnan(found).any(axis=2)
        gain = np.where(faulty, 1, 1 / np.where(faulty, 1, found.mean(axis=2))).astype(np.float32)
    _check_share(faulty, ", ".join(given(settings).values()), "the references leave out most pixels", "good pixels")
    mask = np.where(faulty, np.uint8(USER), np.uint8(0)) if faulty.any() else None
    return Pixels(mask=mask, dark=dark, gain=gain)


def _check_share(faulty: NDArray[np.bool_], place: str, what: str, expected: str) -> None:
    if faulty.mean() > _MOST:
        remedy = "Give the reference of this camera, or leave it out"
        raise SourceError(what, place, f"{expected} at half of the pixels or more", f"{1 - faulty.mean():.0%}", remedy)


def without_effect(settings: ConvertSettings, pixels: Pixels) -> list[str]:
    """Return sentences on references that are given and correct nothing, or nothing but the level.

    Parameters
    ----------
    pixels
        What a movie's store keeps, of :func:`read_references` among other things.
    """
    good = np.bool_(True) if pixels.mask is None else pixels.mask == 0
    found = []
    for name, place in given(settings).items():
        values = {"dark": pixels.dark, "gain_reference": pixels.gain}.get(name)
        if name == "defects" and (pixels.mask is None or not (pixels.mask == USER).any()):
            found.append(f"{place} names no pixel of the frames: no pixel is left out by it")
        elif values is not None and (one := values[np.broadcast_to(good, values.shape)]).size and np.ptp(one) == 0:
            level = name == "dark" and one[0] != 0
            effect = "it lowers all pixels alike" if level else "it changes no pixel"
            said = f" {one[0]:g}" if name == "dark" else ""
            found.append(f"{place} has one value{said} everywhere: {effect}. Is it the right reference?")
    return found


def sensitivity(image: NDArray[np.float64], place: str, by: str) -> NDArray[np.float64]:
    """Return the sensitivity of pixels, of mean 1; NaN where a pixel has none, or one that is out of all proportion."""
    good = np.isfinite(image) & (image > 0)
    if good.mean() < 1 - _MOST:
        raise SourceError(
            "most pixels of the gain reference are not above 0",
            place,
            "numbers about 1, or about the level of an even image",
            f"{1 - good.mean():.0%} of the pixels at 0, below, or no numbers",
            "Give the gain reference itself; subtract a dark image from a flat field before it is saved",
        )
    values = np.where(good, image, np.nan)
    found = values if by == "divide" else 1 / values
    usual = np.nanmedian(found)
    found[(found > _UNLIKE * usual) | (found < usual / _UNLIKE)] = np.nan
    normal: NDArray[np.float64] = found / np.nanmean(found)
    return normal
