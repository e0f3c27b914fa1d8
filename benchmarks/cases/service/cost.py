"""What one request may cost the others: ``python -m benchmarks.cases.service.cost``.

Bodies, forms, tables and files that are absurd. Right: each is refused by name (status 4xx) or done, and meanwhile a
small request of somebody else waits for well under a second.
"""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import h5py

from .started import JSON, started
from .started import tried as tried_on

FORM = {"Content-Type": "application/x-www-form-urlencoded"}
PLAN = b'{"source":"movie.npy","settings":{"fit":'
BODIES = {
    "lists in lists": PLAN + b"[" * 100_000 + b"]" * 100_000 + b"}}",
    "15 million brackets": b"[" * 15_000_000,
    "a text of 31 MiB": b'{"source":"' + b"a" * (31 << 20) + b'"}',
    "a million settings": PLAN + json.dumps({f"k{k}": 0 for k in range(1_000_000)}).encode() + b"}}",
}
FORMS = {
    "a& 500,000 times": b"a&" * 500_000,
    "a=1& 250,000 times": b"a=1&" * 250_000,
    "1 MB of %41": b"token=" + b"%41" * 350_000,
}


def sparse(root: Path) -> None:
    """Make files that are huge and take no room: raw, CSV, and HDF5 with one chunk's worth of frame."""
    for name, size in (("big.raw", 40 << 30), ("big.csv", 6 << 30)):
        with (root / name).open("wb") as file:
            file.truncate(size)
    with h5py.File(root / "wide.h5", "w") as file:
        file.create_dataset("movie", (4, 60000, 60000), "u1", chunks=(1, 6000, 6000), compression="gzip")


def lattice(repeats: int) -> dict[str, Any]:
    """Return a plan of a lattice with so many sites along each side."""
    one = {"origin": [10, 10], "a": [20, 10], "a_count": 1, "b": [10, 20], "b_count": 1}
    several = one | {"a_repeats": repeats, "b_repeats": repeats}
    return {"source": "movie.npy", "settings": {"columns": {"method": "lattice", "lattices": [several]}}}


def main() -> None:
    """Print for each request how it ended, and how long another waited."""
    with started() as service, service.client("alice") as client:
        sparse(service.root)
        files = "/api/v1/files"

        tried = partial(tried_on, service)
        for name, body in BODIES.items():
            tried(name, partial(client.post, "/api/v1/plan", content=body, headers=JSON))
        for name, body in FORMS.items():
            origin = FORM | {"Origin": service.address}
            tried(f"login, {name}", partial(client.post, "/login", content=body, headers=origin))
        one: dict[str, Any] = {"path": "big.raw", "raw_shape": [0, 1, 1], "raw_dtype": "uint8"}
        tried("raw file of 40 GB as frames of a pixel", partial(client.get, f"{files}/about", params=one))
        whole = {"path": "big.raw", "raw_shape": "1,200000,200000", "raw_dtype": "uint8"}
        tried("raw frame of 40 GB", partial(client.get, f"{files}/frame.png", params=whole))
        tried("HDF5 frame of 3.6 GB", partial(client.get, f"{files}/frame.png", params={"path": "wide.h5"}))
        for group in ("columns", "drift"):
            table = {"source": "movie.npy", "settings": {group: {"method": "csv", "csv": "big.csv"}}}
            tried(f"{group} from a CSV file of 6 GB", partial(client.post, "/api/v1/plan", json=table))
        tried("lattice of 1e18 sites", partial(client.post, "/api/v1/plan", json=lattice(10**9)))


if __name__ == "__main__":
    main()
