"""The command line: ``scripts/bench``."""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from . import kernel, machine, pairs, plots, report, runs, scheduler, stages, startup
from .environment import HERE
from .sizes import FULL, SMALL, Size

SECTIONS = {
    "kernel": kernel.run,
    "pairs": pairs.run,
    "startup": startup.run,
    "stages": stages.run,
    "runs": runs.run,
    "scheduler": scheduler.run,
}
DRAWN = {"kernel", "stages", "runs"}
UNPUBLISHED = {"pairs"}
"""Sections that the document does not show so far."""
DOCUMENT = HERE.parent / "docs" / "performance.md"
FIGURE = HERE.parent / "docs" / "images" / "performance.png"
FIGURES = DOCUMENT.with_suffix(".json")


def main() -> None:
    """Measure what is asked for, and print and keep the tables."""
    options = parse()
    size = SMALL if options.small else FULL
    for folder in filter(None, (options.out, options.work)):
        folder.mkdir(parents=True, exist_ok=True)
    kept = options.out / "results.json"
    results = begin(kept, size)
    for name in options.only or SECTIONS:
        with tempfile.TemporaryDirectory(prefix="bench-", dir=options.work) as work:
            results["sections"][name] = SECTIONS[name](size, Path(work))
        kept.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    (options.out / "results.md").write_text(report.markdown(results), encoding="utf-8")
    if set(results["sections"]) >= DRAWN:
        plots.draw(results["sections"], options.out / "performance.png")
    print(report.markdown(results))
    if options.publish:
        report.publish(results, DOCUMENT)
        shutil.copy(kept, FIGURES)
        shutil.copy(options.out / "performance.png", FIGURE)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="scripts/bench", description="Measure speed and precision beside peers.")
    parser.add_argument("--small", action="store_true", help="seconds of work, to see that everything runs")
    parser.add_argument("--only", action="append", choices=SECTIONS, help="only this section; may be given again")
    parser.add_argument("--out", type=Path, default=HERE / "results", help="folder for results (benchmarks/results)")
    parser.add_argument("--work", type=Path, help="folder on a disk with 25 GB free (the system's temporary folder)")
    parser.add_argument("--publish", action="store_true", help="write the figures into docs/performance.md")
    return parser.parse_args()


def begin(kept: Path, size: Size) -> dict[str, Any]:
    """Return results with the sections that an earlier call on this machine left, where it had the same packages."""
    now = {"date": f"{datetime.now(UTC):%Y-%m-%d}", "size": size.name, "machine": machine.describe()}
    before = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
    same = all(before.get(name) == now[name] for name in ("size", "machine"))
    return now | {"sections": before["sections"] if same else {}}


if __name__ == "__main__":
    main()
