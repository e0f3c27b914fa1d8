"""What can be wrong with a file of a run."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..store import damage

STRANGE = "of another run"


@dataclass(frozen=True)
class Fault:
    """What is wrong with a file.

    Attributes
    ----------
    store
        The store that it is part of, or the folder that it lies in.
    stage
        The one that wrote it; ``run`` where it is of no stage.
    what
        ``damaged``, ``missing``, ``unreadable`` (by an error of the system), :data:`STRANGE`, or ``left over``: no part
        of the store, as a writer that was killed leaves it, which does no harm.
    frames
        The first frame in it and the one behind the last; None where it has none.
    help
        What to do, as a sentence without its full stop; empty: what is usual for a file of a store.
    """

    file: Path
    store: Path
    stage: str
    what: str
    why: str
    frames: tuple[int, int] | None = None
    help: str = ""

    def __str__(self) -> str:
        frames = f", frames {self.frames[0]} to {self.frames[1] - 1}" if self.frames else ""
        return f"{self.file}: {self.what}{frames} ({self.why})"

    @property
    def remedy(self) -> str:
        """What to do, as a sentence without its full stop."""
        if self.help:
            return self.help
        if self.what == "left over":
            return f"Remove {self.file}"
        return damage.remedy(self.file)

    def to_record(self) -> dict[str, Any]:
        """Return it as a mapping for JSON."""
        values = {item.name: getattr(self, item.name) for item in dataclasses.fields(self) if item.name != "help"}
        return values | {"file": str(self.file), "store": str(self.store)}
