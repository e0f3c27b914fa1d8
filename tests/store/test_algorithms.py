"""Keys that stay, and each stage's algorithm: number, defaults and results together."""

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import Scene

from tract_dask.readers import open_source
from tract_dask.settings import ConvertSettings, DriftSettings, FitSettings, RunSettings, Settings
from tract_dask.settings.declare import setting
from tract_dask.stages.columns.find import find_columns
from tract_dask.stages.convert.origin import movie_key
from tract_dask.stages.convert.stage import convert
from tract_dask.stages.drift.stage import estimate_drift
from tract_dask.stages.fit import job as fit_job
from tract_dask.stages.fit import stage as fit_stage
from tract_dask.stages.fit.job import Job
from tract_dask.stages.sum import sum_image
from tract_dask.store import keys
from tract_dask.store.columns import column_dataset
from tract_dask.store.keys import ALGORITHMS, KEYED, OTHERWISE, Keyed, counted, stage_key
from tract_dask.store.movie import Movie, open_movie
from tract_dask.store.results import open_results

GOLDEN = Path(__file__).parent / "golden" / "algorithms.json"
NUMBERS = np.arange(6, dtype=np.float64).reshape(2, 3) / 3
DEFAULTS = RunSettings()


# Keys that stay


def groups_of(settings: RunSettings) -> dict[str, Settings]:
    return {item.name: getattr(settings, item.name) for item in dataclasses.fields(settings)}


@pytest.mark.parametrize(
    ("parts", "key"),
    [
        (("convert", "content", {}), "05d78a2aaa8c03f696a636223a09cd008997579eca5b2d0b36a03c27e6ac5664"),
        (
            ("drift", "movie", {"drift.search_px": 12}),
            "6e82a44a53fe7f88b90b53ad8a671558e8ad998b37ba1fcec8ff526a2448ba87",
        ),
        (("sum", "movie", {}, 1.0, NUMBERS), "14634a3c6ebfb845ece7161128c551f0d352218b59ddddd6c6a4673159ccb9f5"),
        (
            ("columns", NUMBERS, {"columns.contrast": "dark", "fit.window_px": 21.0}, b"x,y\n1,2\n"),
            "a537ee1fac878bab66363189edef3a96648a0a1ce88ab1824d0eb699f577decb",
        ),
        (
            ("fit", "movie", {}, NUMBERS, [1, 19, None, 10], ["Ce", "O"]),
            "5b24968ecf6c4747520437d0fa98faddf153b05a1cb5d3b83cbade0f14886315",
        ),
    ],
)
def test_keys_are_frozen(parts, key):
    """On every machine, and in every version: another key here throws the results of all users away."""
    assert stage_key(*parts) == key


def test_the_key_of_a_movie_is_frozen(tmp_path):
    np.save(tmp_path / "movie.npy", np.arange(60, dtype="<u2").reshape(3, 4, 5))
    assert (
        movie_key(open_source(tmp_path / "movie.npy"))
        == "fdb7a955776f03a3f8606cb238328485ff9ed2f3a105031cd91056b48681cc57"
    )
    layout = ConvertSettings(shard_mb=100, codec="zstd")
    assert (
        movie_key(open_source(tmp_path / "movie.npy"), layout)
        == "abafb446b9823cb2616aa717c02565dd3ae3eb7f77b6ef1e4fddf8d4beb661ea"
    )


def test_the_key_of_a_fit_is_frozen():
    movie = Movie(
        path=Path("movie.zarr"),
        shape=(3, 40, 40),
        dtype=np.dtype("u2"),
        key="movie",
        frames_per_shard=1,
        bins=(),
        pixel_size_pm=None,
        frame_time_s=None,
        dose=None,
        gain=1.0,
    )
    columns = column_dataset(np.ones((2, 2)), ["Ce", ""], np.array([1, 2]), np.ones((2, 7)))
    settings = FitSettings(threshold=2, blur_sigma_px=2.0)
    job = Job(columns, np.zeros((3, 2)), np.zeros(3, bool), 19, (0, 9, 0, 9), 2.0, 10, settings)
    assert fit_stage.fit_key(movie, job) == "31b10347c7307dd3886e4c729e4b672af31f14d16008b4e0a5693738bdd76317"


def test_numbers_and_bytes_count_by_value():
    assert stage_key("sum", 1, [2]) == stage_key("sum", 1.0, [2.0])
    assert stage_key("sum", NUMBERS) == stage_key("sum", NUMBERS.astype(">f8"))
    assert stage_key("sum", NUMBERS) != stage_key("sum", NUMBERS.T)
    assert stage_key("sum", NUMBERS) != stage_key("sum", NUMBERS.astype("f4"))


# What counts


def test_defaults_are_in_no_key():
    assert {stage: counted(stage, **groups_of(DEFAULTS)) for stage in ALGORITHMS} == {stage: {} for stage in ALGORITHMS}


def test_every_stage_has_a_number_and_settings():
    assert ALGORITHMS.keys() == KEYED.keys()


@pytest.mark.parametrize("group", ["source", "metadata", "convert", "drift", "columns", "fit"])
def test_every_setting_counts_in_some_way(group):
    """A new setting needs a line in tract_dask/store/keys.py, with its default, for each stage that it changes."""
    settings = getattr(DEFAULTS, group)
    places = {item.place or item.name for items in KEYED.values() for item in items} | OTHERWISE.keys()
    assert {f"{group}.{item.name}" for item in dataclasses.fields(settings)} <= places


@pytest.mark.parametrize("stage", KEYED)
def test_a_setting_that_differs_is_in_the_key_of_its_stage(stage):
    other = {bool: lambda value: not value, str: lambda value: value + "x", float: lambda value: value + 1}
    for item in KEYED[stage]:
        group, _, field = (item.place or item.name).partition(".")
        value = keys.plain(getattr(getattr(DEFAULTS, group), field))
        changed = other.get(type(value), lambda _: [1.0])(value)
        groups = groups_of(DEFAULTS) | {group: _Changed(getattr(DEFAULTS, group), field, changed)}
        assert counted(stage, **groups) == {item.name: changed}


class _Changed:
    """Settings of which one is another, unchecked."""

    def __init__(self, settings: Settings, field: str, value: Any) -> None:
        self._settings = settings
        setattr(self, field, value)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._settings, name)


def test_a_setting_may_be_new_move_and_be_renamed(monkeypatch):
    """With its default it changes no key; elsewhere and under another name it is still the same setting."""

    @dataclasses.dataclass(frozen=True)
    class Registration(Settings):
        reach_px: float | None = setting(None, "Largest step")
        passes: int = setting(2, "New in this version")

    before = stage_key("drift", "movie", counted("drift", drift=DriftSettings(search_px=9)))
    moved = (
        Keyed("drift.method", "auto"),
        Keyed("drift.search_px", None, "registration.reach_px"),
        Keyed("drift.passes", 2, "registration.passes"),
    )
    monkeypatch.setitem(KEYED, "drift", moved)
    groups = {"drift": DriftSettings(), "registration": Registration(reach_px=9)}
    assert stage_key("drift", "movie", counted("drift", **groups)) == before


def test_a_number_that_is_raised_changes_the_key_of_its_stage_alone(monkeypatch):
    before = {stage: stage_key(stage, "x") for stage in ALGORITHMS}
    monkeypatch.setitem(ALGORITHMS, "fit", ALGORITHMS["fit"] + 1)
    assert [stage for stage in ALGORITHMS if stage_key(stage, "x") != before[stage]] == ["fit"]


# Number, defaults and results together


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> dict[str, list[float]]:
    """Results of every stage with its defaults, on one small movie; each from the truth of the stages before it."""
    folder, scene = tmp_path_factory.mktemp("algorithms"), Scene(n_frames=16, seed=5)
    np.save(folder / "movie.npy", scene.counts())
    movie = open_movie(convert(folder / "movie.npy", folder / "movie.zarr"))
    drift, truth, image = estimate_drift(movie), scene.drift_dataset(), scene.summed()
    summed, columns = sum_image(movie, truth), find_columns(image)
    job = fit_job.prepare(movie, scene.columns(), truth, FitSettings(), summed=image)
    fit_stage.fit_movie(movie, job, folder / "results.zarr")
    tracks = open_results(folder / "results.zarr").load()
    level = movie.read_binned(4, 0, 2)
    return {
        "convert": [
            *(movie.frames_per_shard, *movie.bins, *movie.read(3, 4)[0, 70, 40:44]),
            *(*level[1, 20, 10:14], *movie.statistics()["frame_mean"].to_numpy()[:3]),
        ],
        "drift": drift["drift"].to_numpy()[::4].ravel().tolist() + drift["quality"].to_numpy()[::4].tolist(),
        "sum": [*summed["image"].to_numpy()[70:130:20, 40], *summed["exposure"].to_numpy()[:4, 0]],
        "columns": [*columns["fit_ref"].to_numpy()[::5].ravel(), columns.attrs["spacing_px"]],
        "fit": [
            *tracks["fit"].to_numpy()[::5, ::6, :3].ravel(),
            *tracks["intensity"].to_numpy()[::5, ::6].ravel(),
            *tracks["stderr"].to_numpy()[::5, ::6, 1].ravel(),
            *tracks["noise"].to_numpy()[::5, 0],
        ],
    }


@pytest.mark.parametrize("stage", ALGORITHMS)
def test_number_defaults_and_results_of_a_stage_change_together(stage, results):
    golden = json.loads(GOLDEN.read_text())[stage]
    number = str(ALGORITHMS[stage])
    defaults = {item.name: keys.plain(_default(item)) for item in KEYED[stage]}
    found = {"defaults": defaults, "results": [float(f"{value:.5g}") for value in results[stage]]}
    told = (
        f"The defaults or the results of stage {stage} are not those of its algorithm {number}. If that is meant, raise"
        f" ALGORITHMS[{stage!r}] in tract_dask/store/keys.py to"
        f" {max(map(int, golden), default=0) + 1}, change the"
        f" defaults in tract_dask/store/keys.py too, and add this under that number to {GOLDEN.name},"
        " where entries stay:\n"
        f"{json.dumps(found)}"
    )
    assert number in golden, told
    assert max(map(int, golden)) == int(number), told
    released = golden[number]
    assert {name: defaults.get(name) for name in released["defaults"]} == released["defaults"], told
    assert {name: keys.default_of(stage, name) for name in defaults} == defaults, told
    np.testing.assert_allclose(results[stage], released["results"], rtol=2e-4, atol=2e-4, err_msg=told)


def _default(item: Keyed) -> Any:
    group, _, field = (item.place or item.name).partition(".")
    return getattr(getattr(DEFAULTS, group), field)
