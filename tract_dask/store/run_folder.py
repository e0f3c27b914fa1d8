"""The files of a run's folder, and who works in it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from .locks import sole_use


@dataclass(frozen=True)
class RunFolder:
    """The places of everything that a run writes, under one folder."""

    root: Path

    @property
    def movie(self) -> Path:
        """The converted movie."""
        return self.root / "movie.zarr"

    @property
    def drift(self) -> Path:
        """The drift of every frame."""
        return self.root / "drift.zarr"

    @property
    def sum(self) -> Path:
        """The drift-corrected sum."""
        return self.root / "sum.zarr"

    @property
    def columns(self) -> Path:
        """The columns as a table that can be edited; beside it ``columns.zarr`` and ``columns.png``."""
        return self.root / "columns.csv"

    @property
    def results(self) -> Path:
        """The tracks."""
        return self.root / "results.zarr"

    @property
    def report(self) -> Path:
        """What was measured, and how well, as one page."""
        return self.root / "report.html"

    @property
    def settings(self) -> Path:
        """Every setting of the run."""
        return self.root / "run.toml"

    @property
    def events(self) -> Path:
        """What happened when."""
        return self.root / "events.jsonl"

    def stages(self) -> tuple[Path, ...]:
        """Return the stores, in the order of the stages."""
        return (self.movie, self.drift, self.sum, self.columns.with_suffix(".zarr"), self.results)

    def written(self) -> tuple[Path, ...]:
        """Return everything that a run writes: its stores, beside which journals may lie, then its files."""
        return (*self.stages(), self.columns, self.columns.with_suffix(".png"), self.report, self.settings, self.events)

    def paths(self) -> dict[str, str]:
        """Return the paths by name."""
        names = ("movie", "drift", "sum", "columns", "results", "report", "settings", "events")
        return {name: str(getattr(self, name)) for name in names} | {"figure": str(self.columns.with_suffix(".png"))}


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
