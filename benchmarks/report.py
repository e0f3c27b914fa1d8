"""The figures as tables: the goals with what was reached, and every fitter in every case; Markdown."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .fitters import LSQ, PAIRS, POISSON
from .kernel import BRIGHT
from .sizes import QUARTER

Results = Mapping[str, Any]
"""What a section returned."""

KEYS = ("median", "low", "high")
"""What is kept of several measurements."""

BEGIN, END = "<!-- figures: written by scripts/bench -->", "<!-- end of figures -->"


@dataclass(frozen=True)
class Goal:
    """A row of the table of goals.

    Attributes
    ----------
    section
        Which measures it.
    what, against
        In words.
    value
        From the section's results to the figure, or to several of which all have to reach the goal; none where what it
        is compared with was not measured.
    limit, unit
        The goal; None for a figure that only stands beside others.
    at_least
        Whether more is better.
    """

    section: str
    what: str
    against: str
    value: Callable[[Results], Sequence[float]]
    limit: float | None
    unit: str
    at_least: bool = False

    def row(self, results: Results) -> list[str]:
        """Return the cells of the row; none for a figure without a goal that was not measured."""
        found = sorted(self.value(results))
        shown = " to ".join(dict.fromkeys(f"{figure(value)}{self.unit}" for value in (found[:1] + found[-1:])))
        if self.limit is None:
            return [self.what, self.against, shown, "", ""] if found else []
        sign = "≥" if self.at_least else "≤"
        reached = bool(found) and (found[0] >= self.limit if self.at_least else found[-1] <= self.limit)
        verdict = ("yes" if reached else "**no**") if found else "not compared"
        return [self.what, self.against, shown, f"{sign} {self.limit:g}{self.unit}", verdict]


def faster_than(method: str, *rivals: str) -> Callable[[Results], list[float]]:
    """Return a function to how many times faster a method is than the fastest of its rivals, in every bright case."""

    def value(results: Results) -> list[float]:
        found = []
        for case in BRIGHT:
            rows = {row["fitter"]: row["seconds_per_fit"]["median"] for row in results["cases"][case.name]}
            others = [rows[rival] for rival in rivals if rival in rows]
            found += [min(others) / rows[method]] if others else []
        return found

    return value


def _pairs_a_second(results: Results) -> list[float]:
    every = [row for rows in results["cases"].values() for row in rows if row["fitter"] == PAIRS.name]
    return [1 / row["seconds_per_fit"]["median"] for row in every]


def ratio(over: Sequence[str], under: str) -> Callable[[Results], list[float]]:
    """Return a function to the ratio of the times of some stages and of a loop."""

    def value(results: Results) -> list[float]:
        medians = {name: times["median"] for name, times in results["seconds"].items()}
        return [sum(medians[name] for name in over) / medians[under]]

    return value


def _throughput(results: Results) -> list[float]:
    return [results["input_mb"] / results["by_frames"][str(results["frames"])]["seconds"]["median"]]


def _scaling(results: Results) -> list[float]:
    times = {workers: outcome["seconds"]["median"] for workers, outcome in results["by_workers"].items()}
    return [times["1"] / times[str(results["workers"])]]


def _scaling_of_cores(results: Results) -> list[float]:
    if not results.get("on_one_core"):
        return []
    spread = results["by_workers"][str(results["workers"])]
    return [results["on_one_core"]["seconds"]["median"] / spread["seconds"]["median"]]


def _memory_growth(results: Results) -> list[float]:
    peaks = {frames: outcome["worker_peak_mb"]["median"] for frames, outcome in results["by_frames"].items()}
    whole, quarter = peaks[str(results["frames"])], peaks.get(str(results["frames"] // QUARTER))
    return [100 * abs(whole / quarter - 1)] if quarter else []


def _cost_of_a_shard(results: Results) -> list[float]:
    return [results["ms_per_shard"]]


def _driver_growth(results: Results) -> list[float]:
    return [max(0.0, results["driver_mb"]["end"] - results["driver_mb"]["settled"])]


def _startup(name: str) -> Callable[[Results], list[float]]:
    return lambda results: [results[name]["median"]] if name in results else []


_CASES = "kernel, 25 x 25 and 51 x 51, peaks of 20 on 20 and 300 on 300, one core"

GOALS = (
    Goal(
        "kernel",
        f"`lsq` {_CASES}",
        "picasso `gaussfit` rotated, least squares",
        faster_than(LSQ.name, "picasso lsq guess", "picasso lsq seeds"),
        60,
        " x",
        at_least=True,
    ),
    Goal(
        "kernel",
        "the same",
        "scipy `least_squares`, bounds, analytic derivatives",
        faster_than(LSQ.name, "scipy trf"),
        1000,
        " x",
        at_least=True,
    ),
    Goal(
        "kernel",
        f"`poisson` {_CASES}",
        "picasso `gaussfit` rotated, maximum likelihood",
        faster_than(POISSON.name, "picasso poisson guess", "picasso poisson seeds"),
        50,
        " x",
        at_least=True,
    ),
    Goal(
        "pairs",
        "touching pairs, 25 x 25, peaks of 20 on 20 and 300 on 300, one core",
        "both columns are one pair",
        _pairs_a_second,
        30_000,
        " pairs/s",
        at_least=True,
    ),
    Goal(
        "stages",
        "stage `fit`",
        "bare loop that reads and decodes the same tiles",
        ratio(["fit"], "bare fit"),
        1.25,
        " x its time",
    ),
    Goal(
        "stages",
        "stages `drift` and `sum`",
        "bare loop that reads what they read",
        ratio(["drift", "sum"], "bare drift and sum"),
        1.5,
        " x its time",
    ),
    Goal(
        "stages",
        "stage `convert`",
        "bare loop: read pages, encode, write",
        ratio(["convert"], "bare convert"),
        1.25,
        " x its time",
    ),
    Goal(
        "stages",
        "the same",
        "`dask.array.to_zarr` of tifffile's pages",
        ratio(["dask to_zarr"], "convert"),
        3,
        " x faster",
        at_least=True,
    ),
    Goal("runs", "whole `run`, input", "", _throughput, 200, " MB/s", at_least=True),
    Goal("runs", "whole `run`, a worker a core", "one worker", _scaling, 1.8, " x faster", at_least=True),
    Goal(
        "runs",
        "the same",
        "one worker, with its driver and all threads on one core",
        _scaling_of_cores,
        None,
        " x faster",
        at_least=True,
    ),
    Goal("runs", "peak memory of a worker, whole movie", "a quarter of the movie", _memory_growth, 10, " % apart"),
    Goal("scheduler", "driver and scheduler, empty shards", "", _cost_of_a_shard, 1, " ms a shard"),
    Goal("scheduler", "growth of the driver's memory meanwhile", "", _driver_growth, 50, " MB"),
    Goal("startup", "`import tract_dask`", "", _startup("import tract_dask"), 0.5, " s"),
    Goal("startup", "`tract-dask --help`", "", _startup("tract-dask --help"), 0.5, " s"),
    Goal("startup", "first fit, nothing compiled", "", _startup("first fit, cold cache"), 10, " s"),
    Goal("startup", "first fit, kernels in the cache", "", _startup("first fit, warm cache"), 0.5, " s"),
)


def markdown(results: Mapping[str, Any]) -> str:
    """Return everything that was measured: machine, goals, fitters, stages, runs."""
    parts = [machine(results), goals(results["sections"])]
    tables = {"kernel": fitters, "pairs": pairs, "stages": stages, "runs": runs}
    parts += [make(results["sections"][name]) for name, make in tables.items() if name in results["sections"]]
    return "\n\n".join(parts) + "\n"


def publish(results: Mapping[str, Any], document: Path) -> None:
    """Replace the figures in a document by these."""
    text = document.read_text(encoding="utf-8")
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    document.write_text(f"{before}{BEGIN}\n\n{markdown(results)}\n{END}{after}", encoding="utf-8")


def machine(results: Mapping[str, Any]) -> str:
    """Return a paragraph on what it ran on."""
    about = results["machine"]
    peers = results["sections"].get("kernel", {}).get("peers", {})
    parts = [
        f"Measured on {results['date']} ({results['size']} size)",
        f"{about['cpu']}, {about['cores']} cores, {', '.join(about['vector_features'])}",
        f"{about['memory_gb']:g} GB",
        about["system"],
        f"Python {about['python']}",
        _versions(about["packages"]),
    ]
    return "; ".join(parts) + "." + (f" The peers' environment: {_versions(peers)}." if peers else "")


def _versions(packages: Mapping[str, str]) -> str:
    return ", ".join(f"{name} {version}" for name, version in packages.items())


def goals(sections: Mapping[str, Any]) -> str:
    """Return the table of goals."""
    rows = [goal.row(sections[goal.section]) for goal in GOALS if goal.section in sections]
    return table(["what", "against", "measured", "goal", "reached"], list(filter(None, rows)))


def fitters(results: Results) -> str:
    """Return the table of every fitter in every case."""
    return _fits(results["cases"], "window, peak on background", "fits/s")


def pairs(results: Results) -> str:
    """Return the table of fits of pairs, both members of which count as one."""
    return _fits(results["cases"], "window with a pair, peaks on background", "pairs/s")


def _fits(cases: Mapping[str, Any], what: str, rate_of: str) -> str:
    rows = []
    for case, found in cases.items():
        for row in found:
            cost = row["seconds_per_fit"]
            rate, high, low = (figure(1 / cost[key]) for key in KEYS)
            precision = "" if row["precision"] is None else f"{row['precision']:.2f} ± {row['precision_sd']:.2f}"
            name = row["fitter"] if row["same_task"] else f"*{row['fitter']}*"
            rows.append([case, name, rate, f"{low} to {high}", f"{row['success']:.3f}", precision, str(row["windows"])])
    return table([what, "fitter", rate_of, "range", "success", "RMS/CRLB", "windows"], rows)


def stages(results: Results) -> str:
    """Return the table of stages and bare loops."""
    rows = [
        [
            name,
            *(f"{times[key]:.2f}" for key in KEYS),
            figure(results["input_mb"] / times["median"]),
        ]
        for name, times in results["seconds"].items()
    ]
    head = f"{results['frames']} frames, {results['columns']} columns, windows of {results['window_px']} px"
    return table([f"{head}, {results['workers']} workers", "s", "from", "to", "MB of movie/s"], rows)


def runs(results: Results) -> str:
    """Return the table of whole runs."""
    return table(
        ["whole run", "s", "from", "to", "MB of movie/s", "peak of a worker, MB", "where the time goes, s"],
        list(_run_rows(results)),
    )


def _run_rows(results: Results) -> Iterator[list[str]]:
    by_frames = {int(frames): outcome for frames, outcome in results["by_frames"].items()}
    named = [(f"{n} frames, {results['workers']} workers", n, by_frames[n]) for n in sorted(by_frames)]
    named.append((f"{results['frames']} frames, 1 worker", results["frames"], results["by_workers"]["1"]))
    if results.get("on_one_core"):
        name = f"{results['frames']} frames, 1 worker, all on one core"
        named.append((name, results["frames"], results["on_one_core"]))
    for name, frames, outcome in named:
        seconds = outcome["seconds"]
        mb = results["input_mb"] * frames / results["frames"]
        parts = ", ".join(f"{stage} {times['median']:.1f}" for stage, times in outcome["stages"].items())
        cells = [f"{seconds[key]:.1f}" for key in KEYS]
        yield [name, *cells, figure(mb / seconds["median"]), figure(outcome["worker_peak_mb"]["median"]), parts]


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def figure(value: float) -> str:
    """Return a number with three digits.

    Examples
    --------
    >>> figure(1234.5), figure(0.123456), figure(61.04)
    ('1,230', '0.123', '61')
    """
    if abs(value) < 1000:
        return re.sub(r"\.0+$", "", f"{value:#.3g}".rstrip("."))
    return f"{float(f'{value:.3g}'):,.0f}"
