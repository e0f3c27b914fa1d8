"""What a path holds, in a few lines: a movie in any format, a store of any stage, or the folder of a run."""

from __future__ import annotations

import math
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr

from ..errors import StoreError
from ..readers import open_source
from ..readers.source import SourceMetadata
from ..readers.times import has_stamps
from ..settings.run import ConvertSettings, RunSettings
from ..settings.toml import from_toml
from ..stages.convert.references import given
from ..store import datasets, metadata, schema
from ..store.camera import Camera
from ..store.movie import Movie, open_movie
from ..store.pixels import KINDS
from ..store.results import open_results, part_in_words
from ..store.run_folder import STORES, RunFolder


def describe(path: str | Path, settings: RunSettings | None = None) -> dict[str, Any]:
    """Return what ``path`` holds as a JSON-ready mapping from names (with their units) to values.

    Raises
    ------
    SourceError
        Where it is neither a store, nor the folder of a run, nor a movie.
    """
    place = Path(path)
    if RunFolder(place).settings.exists():
        return {"run": str(place)} | {name: _state(place / name) for name in STORES}
    about = metadata.attributes(place)
    if not about:
        return _source(str(path), settings or RunSettings())
    if not about.get("complete"):
        return {"path": str(path), "state": _state(place), "source": about.get("source")}
    kinds = {"movie": _movie, "drift": _drift, "sum": _sum, "columns": _columns}
    found: dict[str, Any] = {"path": str(path), "state": _state(place)}
    return found | kinds.get(about.get("kind", "results"), _results)(place)


def _source(path: str, settings: RunSettings) -> dict[str, Any]:
    with closing(open_source(path, settings.source, settings.metadata)) as source:
        known = source.metadata
        return {
            "path": path,
            "format": source.format,
            "files": len(source.files),
            **_frames(source.shape, source.dtype),
            "pixel size, pm": known.pixel_size_pm,
            "frame time, s": known.frame_time_s,
            "dose, e/A^2": known.dose,
            "gain": known.gain,
            "offset, detector units": known.offset,
            **_along_frames(known),
            **{f"{kind} reference": str(file) for kind, file in known.references.items()},
            "notes": list(known.notes),
        }


def _along_frames(known: SourceMetadata) -> dict[str, str]:
    """Return what the headers of the frames say: the first and the last, and the range of what varies."""
    found = {}
    for name, of in known.along_frames.items():
        if name == "time" and not has_stamps(known):
            continue
        low, high = np.nanmin(of.values), np.nanmax(of.values)
        found[f"{name} of frames, {of.units}"] = f"{of.values[0]:.6g} to {of.values[-1]:.6g}" + (
            f" (from {low:.6g} to {high:.6g})" if (low, high) != (of.values[0], of.values[-1]) else ""
        )
    return found


def _movie(path: Path) -> dict[str, Any]:
    movie = open_movie(path)
    statistics = movie.statistics()
    missing = statistics["frame_bad_pixels"].to_numpy() > 0
    bad = schema.bad_frames(statistics, math.prod(movie.shape[1:]))
    return {
        "source": metadata.attributes(path).get("source"),
        **({"part of the source": words} if (words := part_in_words(movie.part)) else {}),
        **_frames(movie.shape, movie.dtype),
        "pixel size, pm": movie.pixel_size_pm,
        "frame time, s": movie.frame_time_s,
        "dose, e/A^2": movie.dose,
        "gain": movie.gain,
        "offset, detector units": movie.offset,
        **_references(path),
        "shards": len(movie.shards),
        "binned levels": list(movie.bins),
        **_left_out(movie),
        "frames with pixels that are missing": int(missing.sum()),
        "bad frames": int(bad.sum()),
    }


def _references(path: Path) -> dict[str, str]:
    """Return the references that a movie was corrected by."""
    named = given(from_toml(ConvertSettings, metadata.attributes(path).get("settings", ""), str(path)))
    return {name.replace("_", " "): place for name, place in named.items()}


def _left_out(movie: Movie) -> dict[str, float]:
    """Return how many pixels carry no data: of the mask, and by why they are in it; spikes; borders; saturated ones."""
    counts = movie.pixels.counts(movie.shape[1:])
    kinds: dict[str, float] = {f"of them {name}": counts[name] for name in KINDS.values() if name in counts}
    rest: dict[str, float] = {name: counts.get(name, 0) for name in ("spikes", "frames with a border")}
    if movie.pixels.full_scale is not None:
        rest |= {"full scale, detector units": float(movie.pixels.full_scale[0]), "saturated": counts["saturated"]}
    return {"masked pixels": sum(kinds.values())} | kinds | rest


def _frames(shape: tuple[int, int, int], dtype: np.dtype[Any]) -> dict[str, Any]:
    return {
        "frames": shape[0],
        "rows": shape[1],
        "columns of pixels": shape[2],
        "dtype": dtype.name,
        "bytes": int(np.prod(shape, dtype=np.int64)) * dtype.itemsize,
    }


def _drift(path: Path) -> dict[str, Any]:
    drift = datasets.open_dataset(path)
    span = np.ptp(drift["drift"].to_numpy(), axis=0)
    quality = drift["quality"].to_numpy()
    return {
        "frames": drift.sizes["frame"],
        "method": drift.attrs.get("method"),
        "range y, px": round(float(span[0]), 2),
        "range x, px": round(float(span[1]), 2),
        "lowest quality": round(float(quality.min()), 3),
        "median quality": round(float(np.median(quality)), 3),
    }


def _sum(path: Path) -> dict[str, Any]:
    summed = datasets.open_dataset(path)
    return {
        "rows": summed.sizes["y"],
        "columns of pixels": summed.sizes["x"],
        "frames": summed.attrs.get("n_frames"),
        "pixel size, pm": summed.attrs.get("pixel_size_pm"),
        **Camera.of(summed.attrs).in_words(),
    }


def _columns(path: Path) -> dict[str, Any]:
    columns = datasets.open_dataset(path)
    return {
        **_kinds(columns),
        "spacing, px": columns.attrs.get("spacing_px"),
        "window, px": columns.attrs.get("window_px"),
        "blur, px": columns.attrs.get("blur_sigma_px"),
        "sigma of a column, px": columns.attrs.get("sigma_px"),
        "outside the frame": int(((columns["status_ref"] & int(schema.Status.OUTSIDE_FRAME)) > 0).sum()),
        "edited by hand": metadata.attributes(path).get("edited", False),
    }


def _results(path: Path) -> dict[str, Any]:
    try:
        results = open_results(path)
    except StoreError:
        return {"kind": "not one of tract-dask's"}
    about = metadata.attributes(path)
    return {
        "movie": about.get("source"),
        "frames": results.sizes["frame"],
        **_kinds(results),
        **{name.replace("_", " "): value for name, value in about.get("summary", {}).items()},
        "window, px": about.get("window"),
        "blur before the fit, px": results.attrs.get("window_blur_px"),
        "pixel size, pm": about.get("pixel_size_pm"),
    }


def _kinds(columns: xr.Dataset) -> dict[str, Any]:
    kinds = Counter(sorted(map(str, columns["kind"].to_numpy())))
    return {"columns": columns.sizes["column_id"]} | {f"of kind {kind}": count for kind, count in kinds.items() if kind}


def _state(path: Path) -> str:
    if not path.exists():
        return "not there"
    return "complete" if metadata.attributes(path).get("complete") else "unfinished"
