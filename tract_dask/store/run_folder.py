"""The files of a run's folder, and who works in it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from .locks import sole_use

MOVIE, DRIFT, SUM, COLUMNS, RESULTS = "movie.zarr", "drift.zarr", "sum.zarr", "columns.zarr", "results.zarr"
"""Names of the stores in a run's folder."""

STORES = (MOVIE, DRIFT, SUM, COLUMNS, RESULTS)

TABLE, SETTINGS, EVENTS, REPORT = "columns.csv", "run.toml", "events.jsonl", "report.html"
"""Names of its files."""


@dataclass(frozen=True)
class RunFolder:
    """The places of everything that a run writes, under one folder."""

    root: Path

    @property
    def movie(self) -> Path:
        """The converted movie."""
        return self.root / MOVIE

    @property
    def drift(self) -> Path:
        """The drift of every frame."""
        return self.root / DRIFT

    @property
    def sum(self) -> Path:
        """The drift-corrected sum."""
        return self.root / SUM

    @property
    def columns(self) -> Path:
        """The columns as a table that can be edited; beside it ``columns.zarr`` and ``columns.png``."""
        return self.root / TABLE

    @property
    def columns_store(self) -> Path:
        """The columns as they were found."""
        return self.root / COLUMNS

    @property
    def figure(self) -> Path:
        """The columns drawn on the summed image."""
        return self.columns.with_suffix(".png")

    @property
    def results(self) -> Path:
        """The tracks."""
        return self.root / RESULTS

    @property
    def report(self) -> Path:
        """What was measured, and how well, as one page."""
        return self.root / REPORT

    @property
    def settings(self) -> Path:
        """Every setting of the run."""
        return self.root / SETTINGS

    @property
    def events(self) -> Path:
        """What happened when."""
        return self.root / EVENTS

    def stages(self) -> tuple[Path, ...]:
        """Return the stores, in the order of the stages."""
        return (self.movie, self.drift, self.sum, self.columns_store, self.results)

    def written(self) -> tuple[Path, ...]:
        """Return everything that a run writes: its stores, beside which journals may lie, then its files."""
        return (*self.stages(), self.columns, self.figure, self.report, self.settings, self.events)

    def paths(self) -> dict[str, str]:
        """Return the paths by name."""
        names = ("movie", "drift", "sum", "columns", "results", "report", "settings", "events")
        return {name: str(getattr(self, name)) for name in names} | {"figure": str(self.figure)}


def sum_beside(path: Path) -> Path:
    """Return where the summed image lies from which the table or the results at ``path`` were made."""
    return path.with_name(f"{path.stem}_sum.zarr")


@contextmanager
def sole_run(outputs: RunFolder, patience_s: float = 0.0) -> Iterator[None]:
    """Hold the folder against a second run, after waiting at most ``patience_s`` for one that holds it.

    Raises
    ------
    DestinationError
        Where another run holds it.
    """
    with sole_use(outputs.root / ".lock", "another run works in this folder", patience_s):
        yield
