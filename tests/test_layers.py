"""The law of the house: which room imports from which. The tables hold the imports that are used, and no others."""

import ast
import sys
from collections import defaultdict
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "tract_dask"

ALLOWED: dict[str, list[str]] = {
    "errors": [],
    "progress": [],
    "kernels": [],
    "web": [],
    "settings": ["errors"],
    "store": ["errors", "kernels", "settings"],
    "readers": ["errors", "settings"],
    "cluster": ["errors", "progress", "settings", "store"],
    "stages": ["errors", "progress", "kernels", "settings", "store", "readers", "cluster"],
    "analysis": ["errors", "kernels", "settings", "store", "stages"],
    "plots": ["errors", "kernels", "settings", "store", "analysis"],
    "export": ["errors", "kernels", "store", "analysis"],
    "simulate": ["errors", "kernels", "settings", "store", "stages", "analysis"],
    "report": ["errors", "kernels", "web", "settings", "store", "stages", "analysis", "plots"],
    "run": [
        "errors",
        "progress",
        "kernels",
        "settings",
        "store",
        "readers",
        "cluster",
        "stages",
        "analysis",
        "plots",
        "simulate",
        "report",
    ],
    "service": [
        "errors",
        "progress",
        "kernels",
        "web",
        "settings",
        "store",
        "readers",
        "cluster",
        "stages",
        "analysis",
        "export",
        "run",
    ],
    "cli": [
        "errors",
        "progress",
        "settings",
        "cluster",
        "analysis",
        "plots",
        "export",
        "simulate",
        "report",
        "run",
        "service",
    ],
}
"""What each room imports from the others; they stand from left to right, and a room imports only from its left."""

INSIDE: dict[str, dict[str, list[str]]] = {
    "kernels": {
        "vectors": [],
        "windows": ["vectors"],
        "filling": {"windows"},
        "gaussian": ["vectors", "windows"],
        "centroids": ["vectors"],
        "presence": ["vectors", "windows", "gaussian"],
        "scan_rows": ["gaussian"],
        "strength_maps": ["presence", "vectors"],
        "sums": [],
        "registration": ["sums"],
        "alignment": ["registration"],
        "magnitude": [],
        "wiener": ["magnitude"],
        "binning": [],
        "borders": set(),
        "saturation": set(),
        "defects": {"saturation"},
        "greys": [],
        "changepoints": [],
        "hops": [],
        "linear_motion": [],
        "peaks": [],
        "noise": [],
        "patterns": [],
        "rendering": [],
        "total_variation": [],
    },
    "service": {
        "data_root": [],
        "crashes": [],
        "client_answers": [],
        "jobs": ["data_root"],
        "config": ["data_root"],
        "process_pool": ["crashes"],
        "errors": ["data_root", "crashes", "jobs"],
        "outputs": ["data_root", "errors"],
        "job_settings": ["data_root"],
        "deletion": ["data_root", "jobs", "outputs"],
        "event_streams": ["jobs"],
        "views": ["process_pool"],
        "client": ["client_answers", "jobs"],
        "auth": ["jobs", "config", "errors"],
        "metrics": ["jobs", "event_streams"],
        "runner": ["data_root", "crashes", "jobs", "config", "outputs", "job_settings", "deletion"],
        "upstream": [],
        "services": [
            "jobs",
            "config",
            "process_pool",
            "event_streams",
            "views",
            "auth",
            "metrics",
            "runner",
            "upstream",
        ],
        "checks": ["data_root", "jobs", "outputs", "job_settings", "services"],
        "pages": ["auth", "services"],
        "error_handlers": ["crashes", "data_root", "jobs", "errors", "pages"],
        "api": [
            "data_root",
            "jobs",
            "errors",
            "job_settings",
            "deletion",
            "event_streams",
            "views",
            "auth",
            "services",
            "checks",
        ],
        "app": ["config", "auth", "metrics", "services", "pages", "error_handlers", "api"],
        "notebook": ["data_root", "jobs", "views", "auth", "pages", "error_handlers", "api"],
        "server": ["data_root", "jobs", "config", "event_streams", "auth", "app"],
    },
}
"""The same for what lies inside the two largest rooms."""

ABROAD = {"numpy", "numba", "llvmlite"}
"""What kernels may import from outside, beside the standard library."""

FILES = sorted(file for file in PACKAGE.rglob("*.py") if file != PACKAGE / "__init__.py")


def module_of(file: Path) -> tuple[str, ...]:
    """The names that lead to a module of the package, without the package's own."""
    parts = file.relative_to(PACKAGE).with_suffix("").parts
    return parts[:-1] if parts[-1] == "__init__" else parts


MODULES = {module_of(file): file for file in FILES}


def imported(source: str, folder: tuple[str, ...]) -> tuple[set[tuple[str, ...]], set[str]]:
    """Modules of the package, and packages from outside, that a module in ``folder`` imports anywhere."""
    inside, outside = set(), set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.ImportFrom):
            names = (node.module or "").split(".") if node.module else []
            if not node.level and names[0] != PACKAGE.name:
                outside.add(names[0])
                continue
            base = (*folder[: len(folder) - node.level + 1], *names) if node.level else tuple(names[1:])
            parts = [(*base, alias.name) for alias in node.names]
            inside |= {part if part in MODULES or not base else base for part in parts}
        elif isinstance(node, ast.Import):
            found = [alias.name.split(".") for alias in node.names]
            inside |= {tuple(name[1:]) for name in found if name[0] == PACKAGE.name and len(name) > 1}
            outside |= {name[0] for name in found if name[0] != PACKAGE.name}
    return inside, outside


def _folder(file: Path) -> tuple[str, ...]:
    return file.relative_to(PACKAGE).parts[:-1]


def graph() -> dict[tuple[str, ...], set[tuple[str, ...]]]:
    """What each module imports of the package."""
    return {name: imported(file.read_text(encoding="utf-8"), _folder(file))[0] for name, file in MODULES.items()}


def between(rooms: tuple[str, ...] = ()) -> dict[str, set[str]]:
    """What the rooms inside the room ``rooms`` import from each other; all of the package by default."""
    depth, found = len(rooms), defaultdict(set)
    for name, others in graph().items():
        if name[:depth] == rooms and len(name) > depth:
            inside = {other[depth] for other in others if other[:depth] == rooms and len(other) > depth}
            found[name[depth]] |= inside - {name[depth]}
    return found


@pytest.mark.parametrize(
    ("rooms", "table"), [((), ALLOWED), *(((room,), table) for room, table in INSIDE.items())], ids=["house", *INSIDE]
)
def test_rooms_import_what_the_table_says(rooms, table):
    order = list(table)
    assert {room: sorted(others) for room, others in between(rooms).items()} == {
        room: sorted(others) for room, others in table.items()
    }
    for room, others in table.items():
        assert all(order.index(other) < order.index(room) for other in others), f"{room} imports from its right"


def test_routes_reach_the_parts_of_the_application_typed():
    """The untyped state of the application is known where it is made, where it is read, and where it is served."""
    named = {file.stem for file in (PACKAGE / "service").rglob("*.py") if "app.state" in file.read_text("utf-8")}
    assert named == {"app", "services", "server"}


def test_no_modules_import_each_other():
    below, path = graph(), []

    def visit(module: tuple[str, ...], seen: set[tuple[str, ...]]) -> None:
        assert module not in path, " -> ".join(".".join(name) for name in (*path, module))
        if module not in seen:
            path.append(module)
            for other in below.get(module, ()):
                visit(other, seen)
            path.pop()
            seen.add(module)

    seen: set[tuple[str, ...]] = set()
    for module in below:
        visit(module, seen)


@pytest.mark.parametrize("file", sorted((PACKAGE / "kernels").rglob("*.py")), ids=lambda file: file.name)
def test_kernels_know_only_numpy_and_numba(file):
    _, outside = imported(file.read_text(encoding="utf-8"), _folder(file))
    assert outside - set(sys.stdlib_module_names) <= ABROAD


@pytest.mark.parametrize("room", ["store", "readers", "cluster", "stages"])
def test_what_every_run_imports_is_small(room):
    """These parts of SciPy take as long to import as a small movie takes to be tracked."""
    slow = {f"scipy.{name}" for name in ("signal", "stats", "optimize", "interpolate")} | {"matplotlib", "skimage"}
    for file in (PACKAGE / room).rglob("*.py"):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            named = {node.module} if isinstance(node, ast.ImportFrom) else set()
            named |= {alias.name for alias in node.names} if isinstance(node, ast.Import) else set()
            assert not named & slow, file


def test_the_architecture_page_shows_the_table():
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    rows = [f"| `{room}` | {', '.join(f'`{other}`' for other in others) or '–'} |" for room, others in ALLOWED.items()]
    assert "\n".join(rows) in page


@pytest.mark.parametrize(
    ("source", "folder", "inside", "outside"),
    [
        ("from . import journal, schema", ("store",), {("store", "journal"), ("store", "schema")}, set()),
        ("from .store.movie import Movie\nimport numpy.linalg", (), {("store", "movie")}, {"numpy"}),
        (
            "from .source import Source\nfrom ..errors import A",
            ("readers",),
            {("readers", "source"), ("errors",)},
            set(),
        ),
        ("from .. import settings", ("store",), {("settings",)}, set()),
        ("import tract_dask.cli\nfrom tract_dask.store.movie import Movie", (), {("cli",), ("store", "movie")}, set()),
        ("def f():\n    from ..run.pipeline import run", ("cli",), {("run", "pipeline")}, set()),
    ],
)
def test_every_form_of_import_is_seen(source, folder, inside, outside):
    assert imported(source, folder) == (inside, outside)
