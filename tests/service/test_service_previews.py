"""Pictures: every pixel is what the mapping says, for whole and half pixels, zoomed in and out, with gaps."""

from __future__ import annotations

import io
import json

import numpy as np
import pytest
import xarray as xr
from fastapi.testclient import TestClient
from PIL import Image
from serviced import URL, make_app

from tract_dask import convert
from tract_dask.errors import InputError
from tract_dask.service.views.pictures import PERCENTILES, Plane, View, encode_png, levels, look
from tract_dask.settings import ConvertSettings, MetadataSettings
from tract_dask.store import datasets

FINE = 8
"""Parts of a pixel: boxes with edges at eighths can be compared with an enlarged image."""


def decoded(png: bytes) -> np.ndarray:
    with Image.open(io.BytesIO(png)) as image:
        assert image.mode == "L"
        assert image.info["transparency"] == 0
        return np.asarray(image)


def plane(image: np.ndarray, **more) -> Plane:
    return Plane(image.shape, (1,), lambda factor, rows, columns: image[rows, columns], **more)


def enlarged(image: np.ndarray, box, size) -> np.ndarray:
    """The picture by brute force: means over parts of pixels, which are so small that no edge cuts one."""
    height, width = image.shape
    room = np.full(((height + 40) * FINE, (width + 40) * FINE), np.nan)
    inside = slice(20 * FINE, (20 + height) * FINE), slice(20 * FINE, (20 + width) * FINE)
    room[inside] = np.kron(image, np.ones((FINE, FINE)))
    x0, y0, x1, y1 = (round((edge + 0.5 + 20) * FINE) for edge in box)
    part = room[y0:y1, x0:x1]
    rows, columns = size
    blocks = part.reshape(rows, (y1 - y0) // rows, columns, (x1 - x0) // columns)
    known = np.isfinite(blocks)
    count = known.sum(axis=(1, 3))
    return np.where(known, blocks, 0).sum(axis=(1, 3)) / np.where(count, count, np.nan)


@pytest.mark.parametrize(
    ("box", "width"),
    [
        ((-0.5, -0.5, 23.5, 17.5), 12),  # the whole image, halved
        ((-0.5, -0.5, 23.5, 17.5), 6),
        ((0, 0, 12, 9), 4),  # from middle to middle: edges cut pixels
        ((1.25, 2.5, 13.25, 8.5), 8),  # points of one and a half pixels
        ((-8.5, -6.5, 27.5, 20.5), 12),  # beyond the image on all sides
    ],
)
def test_zoomed_out_a_point_is_the_mean_of_its_area(box, width):
    image = np.random.default_rng(1).poisson(5, (18, 24)).astype(float)
    image[3:6, 4:9] = np.nan
    seen = look(plane(image), View(box, width))
    np.testing.assert_allclose(seen, enlarged(image, box, seen.shape), rtol=1e-5)


def test_zoomed_in_a_point_is_the_pixel_that_it_lies_on():
    image = np.arange(30.0).reshape(5, 6)
    np.testing.assert_array_equal(look(plane(image), View(None, 24)), np.kron(image, np.ones((4, 4))))
    seen = look(plane(image), View((0, 0, 2, 1), 8))  # a quarter of a pixel a point, from the middle of pixel (0, 0)
    np.testing.assert_array_equal(seen, np.array([[0, 0, 1, 1, 1, 1, 2, 2]] * 2 + [[6, 6, 7, 7, 7, 7, 8, 8]] * 2))
    beyond = look(plane(image), View((4.5, -1.5, 6.5, 0.5), 2))
    np.testing.assert_array_equal(beyond, [[np.nan, np.nan], [5, np.nan]])


def test_a_box_beside_the_image_is_empty():
    assert np.isnan(look(plane(np.ones((4, 4))), View((10, 10, 20, 20), 5))).all()


def test_a_tall_box_is_as_high_as_a_picture_may_be():
    assert look(plane(np.ones((4, 4))), View((0, 0, 1, 5000), 2000)).shape == (2048, 1)


def test_a_png_is_read_by_others():
    level = np.random.default_rng(2).integers(0, 256, (37, 53)).astype(np.uint8)
    np.testing.assert_array_equal(decoded(encode_png(level)), level)


def test_binned_levels_are_used_where_they_suffice():
    image, read = np.random.default_rng(3).poisson(3, (64, 96)).astype(float), []
    binned = image.reshape(16, 4, 24, 4).mean(axis=(1, 3))

    def part(factor, rows, columns):
        read.append(factor)
        return (image if factor == 1 else binned)[rows, columns]

    pyramid = Plane(image.shape, (1, 4), part, gain=2.0)
    for view in (View(None, 12), View((7.5, 3.5, 39.5, 35.5), 4), View((-0.5, -0.5, 95.5, 63.5), 48)):
        np.testing.assert_allclose(look(pyramid, view), 2 * look(plane(image), view), rtol=1e-5)
    assert read == [4, 4, 1]


def test_levels_tell_what_is_seen():
    image = np.random.default_rng(4).normal(10, 2, (40, 30))
    image[:5] = np.nan
    found = levels(plane(image), View(None, 30))
    known = image[5:]
    assert found["shape"] == [40, 30]
    np.testing.assert_allclose(found["range"], (known.min(), known.max()), rtol=1e-6)
    np.testing.assert_allclose(list(found["percentiles"].values()), np.percentile(known, PERCENTILES), rtol=1e-5)
    assert sum(found["counts"]) == known.size
    nothing = levels(plane(np.full((3, 3), np.nan)), View())
    assert (nothing["range"], nothing["percentiles"], nothing["counts"]) == (None, None, [])


@pytest.mark.parametrize(
    "wrong",
    [
        {"width": 0},
        {"width": 4096},
        {"box": (0.0, 0.0, 0.0, 5.0)},
        {"box": (0.0, 0.0, 1e9, 5.0)},
        {"box": (float("nan"), 0.0, 1.0, 5.0)},
        {"low": 3.0, "high": 3.0},
        {"low": float("inf")},
    ],
)
def test_a_view_that_shows_nothing_is_refused(wrong):
    with pytest.raises(InputError):
        View(**wrong)


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    """A client of the API with a movie in three formats, and a job ``job`` of it, with a summed image."""
    tmp_path = tmp_path_factory.mktemp("root")
    movie = np.random.default_rng(0).poisson(4, (5, 20, 30)).astype(np.uint16)
    np.save(tmp_path / "movie.npy", movie)
    movie.tofile(tmp_path / "movie.raw")
    (tmp_path / "out").mkdir()
    convert(
        tmp_path / "movie.npy",
        tmp_path / "out" / "movie.zarr",
        settings=ConvertSettings(tile_px=16),
        metadata=MetadataSettings(pixel_size_pm=8.0, gain=2.0),
    )
    image = np.random.default_rng(1).normal(20, 3, (20, 30))
    exposure = np.full((20, 30), 5, np.uint32)
    exposure[:, 27:] = 0
    summed = {"image": (("y", "x"), image), "exposure": (("y", "x"), exposure)}
    datasets.write_dataset(xr.Dataset(summed, attrs={"pixel_size_pm": 4.0}), tmp_path / "out" / "sum.zarr")
    app = make_app(tmp_path)
    job = app.state.services.store.submit(source="movie.npy", settings={}, owner="local", output="out")
    client = TestClient(app, base_url=URL)
    client.job, client.movie, client.image = f"jobs/{job.id}", movie, np.where(exposure > 0, image, np.nan)
    return client


def mapped(values: np.ndarray, low: float, high: float) -> np.ndarray:
    level = 1 + np.rint(254 * np.clip((values - low) / (high - low), 0, 1))
    return np.where(np.isfinite(values), np.nan_to_num(level), 0).astype(np.uint8)


@pytest.mark.parametrize(
    ("place", "more", "gain"),
    [
        ("files/frame.png?path=movie.npy", {}, 1),
        ("files/frame.png?path=movie.npy", {"gain": 3}, 3),
        ("files/frame.png?path=movie.raw", {"raw_shape": "0,20,30", "raw_dtype": "uint16"}, 1),
        ("files/frame.png?path=out/movie.zarr", {}, 2),
        ("{job}/frame.png?", {}, 2),
    ],
)
def test_a_frame_of_any_format_is_shown_as_it_is(service, place, more, gain):
    address = f"{place.format(job=service.job)}&frame=3&low=0&high=12&width=30"
    answer = service.get(
        address, params=dict(pair.split("=") for pair in address.split("?")[1].split("&") if pair) | more
    )
    assert answer.headers["content-type"] == "image/png"
    np.testing.assert_array_equal(decoded(answer.content), mapped(gain * service.movie[3].astype(float), 0, 12))


@pytest.mark.parametrize("path", ["movie.npy", "out/movie.zarr"])
def test_a_part_of_a_movie_is_shown_and_described(service, path):
    params = {"path": path, "frames": "1:4:2", "roi": "2:18,4:24", "bin": 2}
    about = service.get("files/about", params=params).json()
    assert about["shape"] == [2, 8, 10]
    own = service.get("files/about", params={"path": path}).json()
    assert about["file_pixel_size_pm"] == own["pixel_size_pm"] == own["file_pixel_size_pm"]
    if own["pixel_size_pm"]:
        assert about["pixel_size_pm"] == 2 * own["pixel_size_pm"]
    summed = service.movie[3, 2:18, 4:24].astype(float).reshape(8, 2, 10, 2).sum((1, 3))
    answer = service.get("files/frame.png", params=params | {"frame": 1, "low": 0, "high": 60, "width": 10})
    gain = 2 if path.endswith(".zarr") else 1  # as it was converted
    np.testing.assert_array_equal(decoded(answer.content), mapped(gain * summed, 0, 60))
    refused = service.get("files/about", params={"path": path, "roi": "0:5"})
    assert refused.status_code == 400
    assert "roi" in refused.text


def test_the_sum_is_shown_with_gaps_where_nothing_was_exposed(service):
    about = service.get(f"{service.job}/sum").json()
    assert about["shape"] == [20, 30]
    assert about["pixel_size_pm"] == 4.0
    known = service.image[np.isfinite(service.image)]
    np.testing.assert_allclose(about["range"], (known.min(), known.max()), rtol=1e-6)
    low, high = about["percentiles"]["1.0"], about["percentiles"]["99.0"]
    params = {"low": low, "high": high, "width": 30, "v": about["version"]}
    answer = service.get(f"{service.job}/sum.png", params=params)
    shown, expected = decoded(answer.content).astype(int), mapped(service.image, low, high).astype(int)
    np.testing.assert_array_equal(shown == 0, ~np.isfinite(service.image))
    assert abs(shown - expected).max() <= 1  # of single precision
    assert answer.headers["cache-control"].startswith("private, max-age=31536000, immutable")
    part = service.get(f"{service.job}/sum.png", params=params | {"box": "9.5,4.5,19.5,14.5", "width": 20})
    np.testing.assert_array_equal(decoded(part.content), np.kron(shown[5:15, 10:20], np.ones((2, 2), int)))


def test_a_picture_is_asked_for_again_only_when_it_changed(service):
    file = service.app.state.services.root.path / "changing.npy"
    np.save(file, service.movie)
    first = service.get("files/frame.png?path=changing.npy&frame=1")
    known = {"If-None-Match": first.headers["etag"]}
    assert first.headers["cache-control"] == "private, no-cache"
    assert service.get("files/frame.png?path=changing.npy&frame=1", headers=known).status_code == 304
    assert service.get("files/frame.png?path=changing.npy&frame=2", headers=known).status_code == 200
    np.save(file, 9 * service.movie)
    again = service.get("files/frame.png?path=changing.npy&frame=1&low=0&high=99&width=30", headers=known)
    np.testing.assert_array_equal(decoded(again.content), mapped(9.0 * service.movie[1], 0, 99))


def test_histograms_of_frames(service):
    found = service.get("files/histogram?path=movie.npy&frame=2&width=30").json()
    assert found["range"] == [service.movie[2].min(), service.movie[2].max()]
    of_job = service.get(f"{service.job}/histogram?frame=2&width=30").json()
    np.testing.assert_allclose(of_job["range"], 2 * np.array(found["range"]))
    assert (found["pixel_size_pm"], of_job["pixel_size_pm"]) == (None, 8.0)


@pytest.mark.parametrize(
    ("address", "status"),
    [
        ("files/frame.png?path=movie.npy&frame=5", 400),
        ("files/frame.png?path=movie.npy&frame=-1", 422),
        ("files/frame.png?path=movie.raw", 400),
        ("files/frame.png?path=../movie.npy", 403),
        ("files/frame.png?path=%2e%2e/movie.npy", 403),
        ("files/frame.png?path=/etc/passwd", 403),
        ("files/frame.png?path=nothing.tif", 404),
        ("files/frame.png?path=movie.npy&box=1,2,3", 422),
        ("files/frame.png?path=movie.npy&box=5,5,1,1", 400),
        ("files/frame.png?path=movie.npy&box=nan,0,1,1", 422),
        ("files/frame.png?path=movie.npy&width=99999", 422),
        ("files/frame.png?path=movie.npy&low=nan", 422),
        ("jobs/0123456789/sum.png", 404),
        ("jobs/nonsense/sum.png", 422),
    ],
)
def test_what_cannot_be_shown_is_refused(service, address, status):
    answer = service.get(address)
    assert answer.status_code == status, answer.text
    assert answer.json()["error"]["text"]


def test_every_parameter_is_described(service):
    paths = json.loads(service.get("openapi.json").content)["paths"]
    own = [path for path in paths if "frame.png" in path or "sum" in path or "/results" in path or "histogram" in path]
    assert len(own) == 12
    for path in own:
        for parameter in paths[path]["get"].get("parameters", []):
            assert parameter.get("description") or parameter["name"] == "column_id", (path, parameter["name"])
