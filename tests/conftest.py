"""Small movies of Gaussian columns on a grid, with everything about them known."""

from __future__ import annotations

import functools
import sys
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from distributed import Client, LocalCluster
from hypothesis import settings
from numba.core.dispatcher import Dispatcher

from tract_dask.stages.fit import join
from tract_dask.store import parts, results, schema
from tract_dask.store.journal import Journal, journal_beside
from tract_dask.store.shards import Shard, split

settings.register_profile("checks", deadline=None)  # a busy machine is no fault of the code
settings.load_profile("checks")


def _untraced(compile_):
    """Let coverage not follow what Numba does when it compiles, which takes it half as long again."""

    @functools.wraps(compile_)
    def compile_untraced(*args, **kwargs):
        tracer = sys.gettrace()
        sys.settrace(None)
        try:
            return compile_(*args, **kwargs)
        finally:
            sys.settrace(tracer)

    return compile_untraced


Dispatcher.compile = _untraced(Dispatcher.compile)


@pytest.fixture(scope="session", autouse=True)
def state_home(tmp_path_factory):
    """Services keep their tokens outside of their data root: here, and not in the home of who runs the tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        yield


@pytest.fixture(scope="module")
def client():
    """A cluster of one worker with two threads, in this process."""
    with (
        LocalCluster(processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None) as local,
        Client(local) as client,
    ):
        yield client


@pytest.fixture
def root(tmp_path):
    """A service's data root."""
    from serviced import make_root

    return make_root(tmp_path / "data")


@pytest.fixture
def api(root):
    """The API of a service on that root."""
    from fastapi.testclient import TestClient
    from serviced import URL, make_app

    return TestClient(make_app(root), base_url=URL, raise_server_exceptions=False)


@pytest.fixture(scope="module")
def chromium():
    """A browser: Debian's Chromium, without which these tests fail."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=["--no-sandbox"])
        yield browser
        browser.close()


@dataclass
class Scene:
    """A grid of elliptical Gaussians on a flat background, with vacuum above it.

    ``place`` (columns, 2) holds (x, y) in px; the frames show it shifted by ``drift`` (frames, 2), (y, x).
    """

    n_frames: int = 12
    shape: tuple[int, int] = (160, 144)
    spacing: float = 30.0
    amplitude: float = 60.0
    background: float = 20.0
    sigma_a: float = 4.0
    sigma_b: float = 3.0
    theta: float = 0.4
    max_drift: float = 4.0
    seed: int = 0
    place: np.ndarray = field(init=False)
    drift: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        y, x = np.meshgrid(
            np.arange(64, self.shape[0] - 20, self.spacing), np.arange(24, self.shape[1] - 20, self.spacing)
        )
        self.place = np.stack([x.T.ravel(), y.T.ravel()], axis=1) + rng.uniform(-0.5, 0.5, (x.size, 2))
        steps = np.cumsum(rng.normal(0, 0.6, (self.n_frames, 2)), axis=0)
        self.drift = np.clip(steps - np.median(steps, axis=0), -self.max_drift, self.max_drift)
        self.drift -= np.median(self.drift, axis=0)

    @property
    def parameters(self) -> np.ndarray:
        """(columns, 7) truth in the summed image."""
        truth = np.empty((len(self.place), 7))
        truth[:] = self.amplitude, 0, 0, self.sigma_a, self.sigma_b, self.theta, self.background
        truth[:, 1:3] = self.place
        return truth

    def frame(self, shift: np.ndarray, present: np.ndarray | None = None) -> np.ndarray:
        """The noise-free scene shifted by ``shift`` (y, x); Equation 1, pixel by pixel."""
        y, x = np.mgrid[: self.shape[0], : self.shape[1]]
        image = np.full(self.shape, self.background, dtype=float)
        cos, sin = np.cos(self.theta), np.sin(self.theta)
        for k, (x0, y0) in enumerate(self.place):
            if present is not None and not present[k]:
                continue
            dx, dy = x - x0 - shift[1], y - y0 - shift[0]
            along, across = dx * cos - dy * sin, dx * sin + dy * cos
            image += self.amplitude * np.exp(-0.5 * (along / self.sigma_a) ** 2 - 0.5 * (across / self.sigma_b) ** 2)
        return image

    def counts(self, present: np.ndarray | None = None, dtype: str = "uint16") -> np.ndarray:
        """Poisson counts of all frames; ``present`` (frames, columns) leaves columns out."""
        rng = np.random.default_rng(self.seed + 1)
        shown = [None] * self.n_frames if present is None else list(present)
        frames = [self.frame(shift, here) for shift, here in zip(self.drift, shown, strict=True)]
        return rng.poisson(frames).astype(dtype)

    def columns(self, blur_sigma_px: float = 2.0) -> xr.Dataset:
        """The true columns, as a columns Dataset: what a fit finds in the blurred scene.

        The blur adds its variance to those of the Gaussian, and leaves the volume.
        """
        truth = self.parameters
        truth[:, 3:5] = np.sqrt(truth[:, 3:5] ** 2 + blur_sigma_px**2)
        truth[:, 0] *= self.sigma_a * self.sigma_b / truth[:, 3:5].prod(axis=1)
        return xr.Dataset(
            {
                "x_ref": ("column_id", truth[:, 1]),
                "y_ref": ("column_id", truth[:, 2]),
                "kind": ("column_id", schema.texts(["Ce"] * len(truth))),
                "fit_ref": (("column_id", "parameter"), truth),
                "status_ref": ("column_id", np.zeros(len(truth), np.uint8)),
            },
            coords={"column_id": np.arange(1, len(truth) + 1)},
            attrs={"window_px": 19, "blur_sigma_px": blur_sigma_px},
        )

    def drift_dataset(self, error: np.ndarray | float = 0.0) -> xr.Dataset:
        """The true drift (plus ``error``), as a drift Dataset."""
        return xr.Dataset(
            {
                "drift": (("frame", "axis"), self.drift + error),
                "quality": ("frame", np.ones(self.n_frames)),
            },
            coords={"frame": np.arange(self.n_frames), "axis": ("axis", schema.texts(schema.AXES))},
        )

    def summed(self) -> xr.Dataset:
        """The noise-free scene, as a summed-image Dataset."""
        return xr.Dataset(
            {
                "image": (("y", "x"), self.frame(np.zeros(2))),
                "exposure": (("y", "x"), np.full(self.shape, self.n_frames, np.uint32)),
            }
        )


def add_fits(
    path: Path, values: dict[str, np.ndarray], shards: Iterable[Shard], step: int, key: str = "key", record: bool = True
) -> Journal:
    """Add the fits of shards to the results at ``path``, as the tasks of the stage do."""
    journal = Journal(journal_beside(path), key)
    for shard in shards:
        with journal.batch() as done:
            part = {name: of[shard.start : shard.stop] for name, of in values.items()}
            parts.write(journal.path, shard, part, step)
            if record:
                done(shard, {})
    return journal


def store_fits(path: Path, values: dict[str, np.ndarray], step: int, key: str = "key") -> None:
    """Store the fits of all frames in the results at ``path``, which are complete then."""
    journal = add_fits(path, values, split(len(values["fit"]), step), step, key)
    join.join(path, journal)
    results.finish(path)
    journal.remove()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow tests begin first, so that none of them is left for the end, and may take longer than the others."""
    for item in items:
        if item.get_closest_marker("slow") and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(600))
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


@pytest.fixture
def scene() -> Scene:
    return Scene()


@pytest.fixture
def npy(tmp_path: Path):
    """Write frames to a .npy file and return its path."""

    def write(frames: np.ndarray, name: str = "movie.npy") -> Path:
        path = tmp_path / name
        np.save(path, frames)
        return path

    return write
