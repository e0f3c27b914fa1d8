"""What tables of many columns cost the others: ``python -m benchmarks.cases.service.large_tables --columns 200000``.

A finished job with so many columns is read, refined, edited and downloaded. Right: each request is answered or refused
by name, and meanwhile a small request of somebody else waits for less than 100 ms.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from functools import partial
from typing import Any

import httpx
import numpy as np

from tract_dask.service.jobs.states import ENDED

from .started import JSON, Started, started
from .started import tried as tried_on

_SPACING_PX = 8


def submitted(service: Started, client: httpx.Client, n_columns: int) -> str:
    """Run a job on two frames of noise with columns on a square grid, and return its number."""
    side = math.ceil(math.sqrt(n_columns))
    counts = np.random.default_rng(0).poisson(3.0, (2, *[_SPACING_PX * (side + 2)] * 2))
    np.save(service.root / "wide.npy", counts.astype("u1"))
    lines = [f"{_SPACING_PX * (k % side + 1.5)},{_SPACING_PX * (k // side + 1.5)}" for k in range(n_columns)]
    (service.root / "wide.csv").write_text("x,y\n" + "\n".join(lines) + "\n")
    settings = {"columns": {"method": "csv", "csv": "wide.csv"}, "drift": {"method": "none"}, "fit": {"window_px": 7}}
    answer = client.post("/api/v1/jobs", json={"source": "wide.npy", "output": "wide", "settings": settings})
    answer.raise_for_status()
    return str(answer.json()["id"])


def waited(client: httpx.Client, job: str) -> str:
    """Wait until a job is over, and return its state."""
    while (state := client.get(f"/api/v1/jobs/{job}").json()["state"]) not in ENDED:
        time.sleep(1)
    return str(state)


def main() -> None:
    """Print for each request how it ended, and how long another waited."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--columns", type=int, default=200_000)
    n_columns = parser.parse_args().columns
    with started() as service, service.client("alice") as client:
        job = submitted(service, client, n_columns)
        print(f"{n_columns} columns: {waited(client, job)}")
        base = f"/api/v1/jobs/{job}"

        tried = partial(tried_on, service)
        table = tried("read a version", partial(client.get, f"{base}/columns/0")).json()
        columns: list[dict[str, Any]] = [
            {name: column[name] for name in ("column_id", "x", "y", "kind")} for column in table.get("columns", [])
        ]
        body = json.dumps({"columns": columns}).encode()
        tried("save a version", partial(client.post, f"{base}/columns", content=body, headers=JSON))
        tried("list versions", partial(client.get, f"{base}/columns"))
        tried("read the saved version", partial(client.get, f"{base}/columns/1"))
        tried("refine", partial(client.post, f"{base}/columns/refine", content=body, headers=JSON))
        for part in ("", "/columns", "/frames", "/series/7", "/displacement"):
            tried(f"results{part}", partial(client.get, f"{base}/results{part}"))
        tried("download", partial(client.get, f"{base}/results/download", params={"format": "csv"}))
        plan = {"source": "wide.npy", "settings": {"columns": {"method": "csv", "csv": "wide.csv"}}}
        tried("plan with the table", partial(client.post, "/api/v1/plan", json=plan))
        tried("page of the job", partial(client.get, f"/jobs/{job}"))


if __name__ == "__main__":
    main()
