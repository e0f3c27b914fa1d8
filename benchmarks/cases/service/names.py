"""Paths that lead out of the data root, or into the service's own folder: ``python -m benchmarks.cases.service.names``.

Hundreds of spellings through every route that takes a path, as a user with a token. Right: none is let through, and
none is an error of the server (status 500 and above). Afterwards: every route without a token, or with a wrong one.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import h5py
import httpx
import numpy as np

from .started import Started, started

RAW = {"raw_shape": "1,8,8", "raw_dtype": "uint8"}
LOOKALIKES = ("..\u200b", "\u200b..", "..\ufeff", "..\u00a0", ".. ", " ..", "..\t", "\uff0e.", "..\u0338", "..\u3000")
STATES = (
    ".tract_dask",
    "\uff0etract_dask",
    "[.]tract_dask",
    "?tract_dask",
    "*tract_dask",
    ".[t]ract_dask",
    ".tract_das?",
)


def names(root: Path) -> list[str]:
    """Make links and files that lead out of the data root, and return names of what must not be seen."""
    outside = root.parent / "outside"
    outside.mkdir()
    np.save(outside / "secret.npy", np.full((2, 16, 16), 77, "u1"))
    for name, target in (("link.npy", outside / "secret.npy"), ("linked", outside), ("state", root / ".tract_dask")):
        (root / name).symlink_to(target)
    with h5py.File(outside / "far.h5", "w") as file:
        file["d"] = np.full((2, 16, 16), 77, "u1")
    with h5py.File(root / "external.h5", "w") as file:
        file["d"] = h5py.ExternalLink(str(outside / "far.h5"), "/d")
    secret = "outside/secret.npy"
    found = ["/etc/passwd", "//etc/passwd", "/proc/self/environ", f"..\\{secret}", "file:///etc/passwd"]
    found += [f"{'../' * k}{end}" for k in range(1, 8) for end in (secret, "etc/passwd")]
    found += [f"{'..%2f' * k}{secret}" for k in range(1, 4)] + [f"jobs/{'../' * k}{secret}" for k in range(1, 5)]
    found += [f"{dots}/{secret}" for dots in LOOKALIKES]
    found += [f"{state}/{end}" for state in STATES for end in ("service.sqlite", "*.sqlite", "*.token")]
    found += ["link.npy", "linked/secret.npy", "linked/*.npy", "state/service.sqlite", "external.h5::/d"]
    return list(dict.fromkeys(found))


def asked(client: httpx.Client, name: str) -> Iterator[tuple[str, httpx.Response]]:
    """Yield what each route says to a name."""
    for route in ("about", "frame.png", "histogram"):
        yield route, client.get(f"/api/v1/files/{route}", params={"path": name} | RAW)
    yield "folder", client.get("/api/v1/files", params={"path": name})
    raw = {"source": {"raw_shape": [1, 8, 8], "raw_dtype": "uint8"}}
    yield "plan", client.post("/api/v1/plan", json={"source": name, "settings": raw})
    yield "output", client.post("/api/v1/plan", json={"source": "movie.npy", "output": name})
    for group in ("columns", "drift"):
        table = {group: {"method": "csv", "csv": name}}
        yield f"{group}.csv", client.post("/api/v1/plan", json={"source": "movie.npy", "settings": table})


def without_a_token(service: Started) -> None:
    """Ask every route without a token and with wrong ones, and print which let that in."""
    paths = service.client("boss").get("/api/v1/openapi.json").json()["paths"]
    wrong: tuple[dict[str, str], ...] = (
        {},
        {"Authorization": "Bearer x"},
        {"Authorization": f"Bearer {service.tokens['boss'][:-1]}"},
    )
    bad, number = [], 0
    with service.client() as client:
        for (path, operations), headers in itertools.product(paths.items(), wrong):
            place = path.replace("{job_id}", "0123456789").replace("{version}", "1").replace("{column_id}", "1")
            for method in operations:
                status = client.request(method.upper(), place, headers=headers).status_code
                number += 1
                if status < 400 or status >= 500:
                    bad.append(f"{method} {path} {status}")
    print(f"{number} requests without a good token; let in, or an error: {sorted(set(bad))}", flush=True)


def main() -> None:
    """Print what was let through."""
    with started() as service, service.client("alice") as client:
        through, broken, number = [], [], 0
        for name in names(service.root):
            for route, answer in asked(client, name):
                number += 1
                if answer.status_code < 300:
                    through.append(f"{route} {name!r}")
                elif answer.status_code >= 500:
                    broken.append(f"{route} {name!r} {answer.status_code}")
        print(f"{number} requests; let through: {through}; errors of the server: {broken}", flush=True)
        without_a_token(service)


if __name__ == "__main__":
    main()
