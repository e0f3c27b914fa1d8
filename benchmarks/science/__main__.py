"""The command line: ``python -m benchmarks.science DATA``."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable
from pathlib import Path

from . import filters, jumps, levels, moves, occupancy, pairs, precision, scale
from .tables import Table, markdown, publish

SECTIONS: dict[str, Callable[[Path, Path], list[Table]]] = {
    "precision": precision.run,
    "pairs": pairs.run,
    "moves": moves.run,
    "jumps": jumps.run,
    "levels": levels.run,
    "occupancy": occupancy.run,
    "filters": filters.run,
    "scale": scale.run,
}
DOCUMENT = Path(__file__).parents[2] / "docs" / "science.md"


def main() -> None:
    """Measure what is asked for, and print the tables."""
    options = parse()
    for name in options.only or SECTIONS:
        with tempfile.TemporaryDirectory(prefix="science-", dir=options.work) as work:
            text = markdown(SECTIONS[name](options.data, Path(work)))
        print(f"## {name}\n\n{text}\n", flush=True)
        if options.publish:
            publish(name, text, DOCUMENT)


def parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.science", description="Measure on simulated data how well everything is measured."
    )
    parser.add_argument("data", type=Path, help="folder of the simulated data, see benchmarks/science/scenes.py")
    parser.add_argument("--only", action="append", choices=SECTIONS, help="only this section; may be given again")
    parser.add_argument("--work", type=Path, help="folder on a disk with 5 GB free (the system's temporary folder)")
    parser.add_argument("--publish", action="store_true", help="write the tables into docs/science.md")
    return parser.parse_args()


if __name__ == "__main__":
    main()
