"""Files of a finished run, damaged one by one: each reader raises an error of ours, or gives the same numbers."""

import zlib
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from conftest import Scene
from distributed import Client, LocalCluster

from tract_dask import pipeline, stores
from tract_dask.errors import StoreError
from tract_dask.movie import open_movie
from tract_dask.results import open_results
from tract_dask.settings import ConvertSettings, RunSettings
from tract_dask.verify import verify

SETTINGS = RunSettings(convert=ConvertSettings(shard_mb=1, tile_px=64))
STORES = ("movie", "drift", "sum", "columns", "results")


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Path:
    """A finished run's folder, with the movie beside it; each test leaves it as it was."""
    folder = tmp_path_factory.mktemp("run")
    np.save(folder / "movie.npy", Scene().counts())
    with (
        LocalCluster(processes=False, n_workers=1, threads_per_worker=2, dashboard_address=None) as local,
        Client(local) as client,
    ):
        pipeline.run(folder / "movie.npy", folder / "out", SETTINGS, client=client, report=False)
    return folder / "out"


def numbers(dataset: xr.Dataset) -> bytes:
    """Everything that a Dataset says."""
    told = [repr(sorted(dataset.attrs.items()))]
    for name in sorted(map(str, dataset.variables)):
        values = dataset[name].to_numpy()
        told += [name, repr(dataset[name].attrs), str(values.dtype), str(values.shape)]
        told.append(repr(values.tolist()) if values.dtype.kind in "OT" else values.tobytes().hex())
    return "\n".join(told).encode()


def read_movie(store: Path) -> bytes:
    movie = open_movie(store)
    parts = [movie.read(0, movie.n_frames), *(movie.read_binned(factor, 0, movie.n_frames) for factor in movie.bins)]
    tiles = [pixels.tobytes() for shard in movie.shards for *_, pixels in movie.tiles(shard)]
    coordinates = [movie.frames[axis].to_numpy().tobytes() for axis in "tyx"]
    about = repr((movie.shape, movie.dtype, movie.key, movie.bins, movie.pixel_size_pm, movie.gain)).encode()
    return b"".join([*(part.tobytes() for part in parts), *tiles, *coordinates, numbers(movie.statistics()), about])


def read_results(store: Path) -> bytes:
    tracks = open_results(store).compute(scheduler="synchronous")
    alone = [np.asarray(stores.open_array(store / name)[:]).tobytes() for name in ("fit", "status", "presence")]
    return b"".join([numbers(tracks), *alone, repr(stores.attributes(store)).encode()])


def read(store: Path) -> bytes:
    """All that a store says, by the ways in which this package reads it."""
    readers = {"movie": read_movie, "results": read_results}
    return readers.get(store.stem, lambda path: numbers(stores.open_dataset(path)))(store)


def flip(data: bytearray, rng: np.random.Generator) -> bytearray:
    data[rng.integers(len(data))] ^= 1 << rng.integers(8)
    return data


def flip_the_end(data: bytearray, rng: np.random.Generator) -> bytearray:
    data[-rng.integers(1, min(60, len(data)) + 1)] ^= 1 << rng.integers(8)
    return data


def zero_a_run(data: bytearray, rng: np.random.Generator) -> bytearray:
    start = rng.integers(len(data))
    data[start : start + 64] = bytes(len(data[start : start + 64]))
    return data


def cut(data: bytearray, rng: np.random.Generator) -> bytearray:
    return data[: rng.integers(1, len(data))]


DAMAGE = {
    "flipped": flip,
    "flipped at the end": flip_the_end,
    "run zeroed": zero_a_run,
    "cut": cut,
    "zeroed": lambda data, rng: bytearray(len(data)),
    "emptied": lambda data, rng: bytearray(),
    "deleted": lambda data, rng: None,
}


def some(store: Path, most: int, rng: np.random.Generator) -> list[Path]:
    """The root's metadata, and some of the other files: of every array one at least, if there is room."""
    arrays: dict[Path, list[Path]] = {}
    for file in rng.permutation(sorted(path for path in store.rglob("*") if path.is_file())):
        arrays.setdefault(file.parent, []).append(file)
    rest = [file for files in arrays.values() for file in files[1:]]
    return list(dict.fromkeys([store / "zarr.json", *(files[0] for files in arrays.values()), *rest]))[:most]


def damage(run: Path, name: str, how: str, seed: int, most: int) -> list[str]:
    """Damage files of a store one by one; return what was not told as it should be."""
    store, rng = run / f"{name}.zarr", np.random.default_rng([seed, zlib.crc32(f"{name}{how}".encode())])
    good, wrong = read(store), []
    for file in some(store, most, rng):
        whole = file.read_bytes()
        broken = DAMAGE[how](bytearray(whole), rng)
        if broken == whole:
            continue
        file.unlink() if broken is None else file.write_bytes(broken)
        faults = {fault.file for fault in verify(store).faults}
        try:
            same = read(store) == good
            if not same:
                wrong.append(f"{file}: read in silence")
            if file not in faults and file.name != "zarr.json":  # of that, white space may be damaged
                wrong.append(f"{file} is sound to verify")
        except StoreError as error:
            if str(file) != error.where or not error.remedy:
                wrong.append(f"{file}: {error}")
            if file not in faults:
                wrong.append(f"{file} is not named by verify")
        except Exception as error:  # noqa: BLE001  any other is what this test is for
            wrong.append(f"{file}: {type(error).__name__}: {error}")
        file.write_bytes(whole)
    return wrong


@pytest.mark.parametrize("name", STORES)
@pytest.mark.parametrize("how", DAMAGE)
def test_no_damage_is_silent(run, name, how):
    assert damage(run, name, how, seed=0, most=10) == []
