"""What is damaged, said so: the file, its frames, and what makes it whole again."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from ..errors import StoreError
from .files import read_small

METADATA = "zarr.json"
_METADATA_BYTES = 16 << 20

_OTHER_CHECKSUM = "its checksum is that of other data"

FRAME_AXES = ("t", "frame")
"""Names of the axis along which the frames lie."""


def damaged(file: Path, why: str, kind: str = "is damaged") -> StoreError:
    """Return the error for a file of a store: what is in it, why, and what to do."""
    frames = frames_in(file)
    what = f"frames {frames[0]} to {frames[1] - 1}" if frames else "this part of the store"
    verb = kind.replace("is ", "are ", 1) if frames else kind
    return StoreError(f"{what} {verb}", str(file), got=why, remedy=remedy(file))


def unreadable(file: Path, error: OSError) -> StoreError:
    """Return the error for a file that the system does not give: no word of damage. Raise it from ``error``."""
    frames = frames_in(file)
    what = f"frames {frames[0]} to {frames[1] - 1} cannot be read" if frames else "it cannot be read"
    got = os.strerror(error.errno) if error.errno else str(error)
    return StoreError(what, str(file), got=got, remedy="Repair the disk or the permissions, then run again")


@contextmanager
def reading(file: Path) -> Iterator[None]:
    """Turn what goes wrong while a file of a store is read and decoded into a StoreError that names it."""
    try:
        yield
    except FileNotFoundError as error:
        raise damaged(file, "no such file", "is missing") from error
    except OSError as error:
        raise unreadable(file, error) from error
    except (ValueError, RuntimeError) as error:
        words = str(error)
        raise damaged(file, _OTHER_CHECKSUM if words.startswith("Stored and computed") else words) from error


def read_json(file: Path) -> dict[str, Any]:
    """Return what a ``zarr.json`` holds; empty where there is none.

    Raises
    ------
    StoreError
        Where it is no such file, or cannot be read.
    """
    try:
        found = json.loads(read_small(file, _METADATA_BYTES))
    except (FileNotFoundError, NotADirectoryError):
        return {}
    except OSError as error:
        raise unreadable(file, error) from error
    except (ValueError, RecursionError) as error:
        raise damaged(file, str(error)) from error
    if not isinstance(found, dict) or not isinstance(found.get("attributes", {}), dict):
        raise damaged(file, "no metadata of Zarr")
    return found


def store_of(file: Path) -> Path:
    """Return the store that a file belongs to, also where its own metadata are gone."""
    folder = next((folder for folder in file.parents if folder.suffix == ".zarr"), file.parent)
    while (folder.parent / METADATA).exists():
        folder = folder.parent
    return folder


def frames_in(file: Path) -> tuple[int, int] | None:
    """Return the first frame of a chunk's file and the one behind its last; None where it has no frames."""
    try:
        about = json.loads(read_small(file.parent / METADATA, _METADATA_BYTES))
        number = int(file.name.split(".")[1])
        step, length = about["chunk_grid"]["configuration"]["chunk_shape"][0], about["shape"][0]
        in_frames = about["dimension_names"][0] in FRAME_AXES
    except (OSError, ValueError, LookupError, TypeError):
        return None
    return (number * step, min(length, (number + 1) * step)) if in_frames else None


def remedy(file: Path) -> str:
    """Return what makes a damaged store whole again, as a sentence without its full stop."""
    store, again = store_of(file), "run the command that wrote it again"
    if not store.parent.exists():
        return f"{store.parent} is not there any more: run the command in the folder's new place, or bring it back"
    if any(folder.name.endswith(".zarr.journal") for folder in file.parents):
        return "Run the same command again: it makes again what is damaged"
    if file.name != METADATA and (store / "frame_bad_pixels").exists():  # a movie
        return f"tract-dask verify {store} --repair makes it again from the source of the movie"
    if (store / "status_ref").exists() and not (store / "fit").exists():
        table = store.with_suffix(".csv")
        return (
            f"Remove {store}, move {table.name} from there, and {again}; if you have edited the table, give it with "
            "--columns-csv"
        )
    return f"Remove {store} and {again}: nothing else is made again"
