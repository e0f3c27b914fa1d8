"""Who may import whom: the table of the design. An edge that is not in it fails."""

import ast
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "tract_dask"

GROUND = {"errors", "settings", "schema", "progress"}
STORES = GROUND | {"damage", "disk", "journal", "keyed", "provenance", "shards", "stamps", "stores"}
MOVIE = STORES | {"io", "movie", "kernels", "pixel_range", "processor"}
STAGES = MOVIE | {"conversion", "layout", "drift", "summing", "columns", "fit", "results", "plots", "seeds", "windows"}
RUN = STAGES | {"cluster", "dispatch", "inputs", "stages", "pipeline", "tasks", "tls"}

ALLOWED = {
    "errors": set(),
    "lazy": set(),
    "system": {"errors"},
    "progress": set(),
    "small_files": set(),
    "locks": {"errors", "small_files"},
    "schema": {"errors"},
    "settings": {"errors"},
    "keyed": {"settings"},
    "processor": {"kernels"},
    "provenance": {"keyed", "processor", "settings"},
    "stamps": {"errors"},
    "disk": set(),
    "stores": {"damage", "disk", "errors", "schema", "shard_files"},
    "damage": {"errors", "small_files"},
    "shards": set(),
    "journal": {"disk", "errors", "shard_files", "shards", "stores"},
    "tries": {"errors", "progress"},
    "deaths": set(),
    "dispatch": {"deaths", "errors", "journal", "shards", "tries"},
    "tasks": {"dispatch", "errors", "journal", "progress", "shards", "tries"},
    "kernels": set(),
    "io": STORES,
    "shard_files": {"disk"},
    "layout": {"settings", "kernels", "shard_files"},
    "ome": {"damage", "schema", "stores"},
    "movie": STORES | {"kernels", "ome", "shard_files"},
    "conversion": STORES | {"io", "kernels", "layout", "ome", "shard_files", "tasks"},
    "passes": STORES | {"movie", "shard_files", "tasks"},
    "lattice": {"kernels"},
    "seeds": GROUND | {"small_files"},
    "windows": {"errors"},
    "vacuum": GROUND | {"kernels"},
    "pixel_range": {"errors"},
    "filtering": MOVIE,
    "measure": MOVIE | {"filtering"},
    "parts": STORES | {"shard_files", "tasks"},
    "results": STORES | {"parts", "shard_files"},
    "plots": MOVIE | {"analysis", "lazy", "results", "seeds"},
    "drift": MOVIE | {"passes", "small_files"},
    "summing": MOVIE | {"passes"},
    "detection": MOVIE | {"lattice", "passes", "seeds", "windows"},
    "columns": MOVIE | {"detection", "lattice", "seeds", "windows"},
    "fit": MOVIE | {"measure", "parts", "results", "tasks", "vacuum", "windows"},
    "comparison": MOVIE | {"filtering", "fit", "measure", "plots"},
    "dose": MOVIE | {"fit", "shard_files"},
    "analysis": MOVIE | {"columns", "measure", "results", "seeds", "vacuum", "windows"},
    "export": GROUND | {"analysis", "results", "stores"},
    "figures": MOVIE | {"analysis", "comparison", "dose", "plots", "results"},
    "simulate": GROUND | {"analysis", "kernels", "lazy", "seeds", "stores", "windows"},
    "tls": {"certificates", "errors"},
    "slurm": {"deaths", "errors", "forkserver", "settings", "tls"},
    "supervision": set(),
    "ssh": {"deaths", "errors", "forkserver", "settings", "supervision", "tls"},
    "dask_dashboard": set(),
    "cluster": {"dask_dashboard", "deaths", "dispatch", "errors", "settings", "forkserver", "slurm", "ssh", "tls"},
    "forkserver": set(),
    "preload": {"kernels", "lazy", "stages"},
    "stages": STAGES | {"passes"},
    "faults": {"damage"},
    "beside": GROUND | {"faults", "keyed", "seeds", "small_files", "stores"},
    "verify": STORES | {"beside", "conversion", "faults", "locks", "ome", "parts", "shard_files"},
    "web": set(),
    "report": MOVIE | {"analysis", "plots", "results", "small_files", "web", "windows"},
    "inputs": STAGES | {"cluster", "vacuum"},
    "pipeline": STAGES | {"cluster", "inputs", "locks", "report", "stages", "tls", "tries"},
    "describe": RUN,
    "demo": RUN | {"simulate"},
    "editor": RUN | {"service"},
    "options": {"settings"},
    "console": {"options"},
    "interrupts": set(),
    "program": {"cli", "interrupts"},
    "certificates": {"errors"},
    "service": RUN
    | {"parts", "analysis", "certificates", "deaths", "describe", "export", "forkserver", "lazy", "locks"}
    | {"meter", "report", "shard_files", "small_files", "supervision", "terminal", "tries", "web"},
    "client": {"errors", "results", "service", "settings"},
    "remote": {"client", "console", "errors", "options", "progress", "settings", "terminal"},
    "hosting": {"certificates", "console", "lazy", "options", "service", "settings"},
    "meter": {"progress"},
    "terminal": {"meter", "progress"},
    "cli": RUN
    | {"comparison", "demo", "describe", "export", "figures", "forkserver"}
    | {"console", "editor", "hosting", "interrupts", "lazy", "options", "remote", "report", "simulate", "system"}
    | {"terminal", "verify"},
}
"""What each room (a file or a folder of the package) may import from the others."""

ABROAD = {"numpy", "numba", "llvmlite"}
"""What kernels may import from outside, beside the standard library."""


def room_of(file: Path) -> str:
    return file.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(source: str, depth: int) -> tuple[set[str], set[str]]:
    """Rooms of the package, and packages from outside, that a module imports; it lies ``depth`` folders down."""
    rooms, outside = set(), set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom) and node.level > depth:
            rooms |= {node.module.split(".")[0]} if node.module else {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and not node.level:
            first, *rest = node.module.split(".")
            if first == PACKAGE.name:
                rooms |= {rest[0]} if rest else {alias.name for alias in node.names}
            else:
                outside.add(first)
        elif isinstance(node, ast.Import):
            names = [alias.name.split(".") for alias in node.names]
            rooms |= {name[1] for name in names if name[0] == PACKAGE.name and len(name) > 1}
            outside |= {name[0] for name in names if name[0] != PACKAGE.name}
    return rooms, outside


FILES = sorted(file for file in PACKAGE.rglob("*.py") if file != PACKAGE / "__init__.py")


@pytest.mark.parametrize("file", FILES, ids=lambda file: str(file.relative_to(PACKAGE)))
def test_imports_point_downwards(file):
    room = room_of(file)
    rooms, _ = imports(file.read_text(encoding="utf-8"), len(file.relative_to(PACKAGE).parts) - 1)
    assert room in ALLOWED, f"{room} is new: say in the table what it may import"
    assert rooms - {room} <= ALLOWED[room]


@pytest.mark.parametrize("file", sorted((PACKAGE / "kernels").glob("*.py")), ids=lambda file: file.name)
def test_kernels_know_only_numpy_and_numba(file):
    _, outside = imports(file.read_text(encoding="utf-8"), 1)
    assert outside - set(sys.stdlib_module_names) <= ABROAD


def test_the_table_has_no_cycles():
    def below(room: str, path: tuple[str, ...] = ()) -> None:
        assert room not in path, f"a cycle: {' -> '.join((*path, room))}"
        for other in ALLOWED[room]:
            below(other, (*path, room))

    for room in ALLOWED:
        below(room)


def test_every_room_of_the_table_is_there():
    assert set(ALLOWED) == {room_of(file) for file in FILES}


@pytest.mark.parametrize(
    ("source", "depth", "rooms", "outside"),
    [
        ("from . import stores, schema", 0, {"stores", "schema"}, set()),
        ("from .io import open_source\nimport numpy.linalg", 0, {"io"}, {"numpy"}),
        ("from .source import Source\nfrom ..errors import TractError", 1, {"errors"}, set()),
        ("from .. import fit", 1, {"fit"}, set()),
        ("import tract_dask.cli.main\nfrom tract_dask.store.movie import Movie", 0, {"cli", "movie"}, set()),
        ("def f():\n    from .pipeline import run", 0, {"pipeline"}, set()),
    ],
)
def test_every_form_of_import_is_seen(source, depth, rooms, outside):
    assert imports(source, depth) == (rooms, outside)
