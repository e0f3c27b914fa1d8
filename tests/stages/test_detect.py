"""Columns that stand out of the noise: in one image and in every frame, against scenes of known truth."""

import numpy as np
import pytest
import xarray as xr
from scipy.spatial import cKDTree

from tract_dask import convert, detect_columns, find_columns, link_detections, open_movie
from tract_dask.errors import InputError, SettingsError
from tract_dask.kernels.gaussian.parameters import AMPLITUDE
from tract_dask.settings import ColumnSettings, ConvertSettings, MetadataSettings
from tract_dask.stages.columns.detect import METHODS, Detector
from tract_dask.store.columns import column_dataset, positions

SPACING = 30.0
SETTINGS = ColumnSettings(spacing_px=SPACING, min_amplitude=0.0)


def movie_of(scene, tmp_path, npy, present=None, name="movie"):
    made = convert(
        npy(scene.counts(present), f"{name}.npy"),
        tmp_path / f"{name}.zarr",
        settings=ConvertSettings(tile_px=64, shard_mb=1),
        metadata=MetadataSettings(pixel_size_pm=4.0),
    )
    return open_movie(made)


def found_at(detections) -> np.ndarray:
    return np.stack([detections.x.to_numpy(), detections.y.to_numpy()], axis=1)


def misses(places, truth) -> tuple[np.ndarray, np.ndarray]:
    """How far each true place is from the nearest found one, and each found one from the nearest true one."""
    return cKDTree(places).query(truth)[0], cKDTree(truth).query(places)[0]


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("contrast", ["bright", "dark"])
def test_every_method_finds_every_column(scene, method, contrast):
    """In one frame of counts, to 1 px, and nothing else: at a threshold of 6 noise passes in one frame of thousands."""
    frame = np.random.default_rng(0).poisson(scene.frame(np.zeros(2))).astype(float)
    image = frame if contrast == "bright" else 200 - frame
    settings = ColumnSettings(spacing_px=SPACING, min_amplitude=0.0, contrast=contrast, detection_threshold=6.0)
    found = detect_columns(image, method, settings=settings)
    missed, wrong = misses(found_at(found), scene.place)
    assert found.sizes["detection"] == len(scene.place)
    assert missed.max() <= 1.0
    assert wrong.max() <= 1.0
    assert (np.diff(found.strength) <= 0).all()


@pytest.mark.parametrize("method", METHODS)
def test_strengths_are_in_units_of_the_noise(method):
    """Maxima of white noise alone: the map's standard deviation is 1 to 10 %, whatever the noise.

    A map of independent values at a spacing of 4 px would have that many maxima above 3 as a normal one has values.
    """
    rng = np.random.default_rng(1)
    template = np.exp(-(np.hypot(*np.mgrid[-7:8, -7:8]) ** 2) / 32)
    detector = Detector(method, SPACING, 0.0, template=template)
    for noise in (1.0, 40.0):
        image = rng.normal(100.0, noise, (400, 400))
        make = {"maxima": detector._relief, "blobs": detector._blobs, "template": detector._likeness}[method]
        raised = make(image, np.ones(image.shape, bool), noise)
        spread = float((raised.height / raised.noise)[20:-20, 20:-20].std())
        budget = 0.35 if method == "blobs" else 0.12  # of three scales the highest: less spread, higher mean
        assert abs(spread - 1) <= budget


def test_columns_from_the_summed_image(scene):
    """``find_columns`` takes the methods as its own, and refines what they find: to 0.05 px without noise."""
    for method in METHODS:
        found = find_columns(scene.summed(), ColumnSettings(method=method, spacing_px=SPACING, min_amplitude=0.5))
        missed, wrong = misses(positions(found), scene.place)
        assert found.sizes["column_id"] == len(scene.place)
        assert max(missed.max(), wrong.max()) <= 0.05


def test_min_amplitude_leaves_weak_ones_out(scene):
    frame = scene.frame(np.zeros(2)) + 0.2 * (scene.frame(np.array([14.0, 14.0])) - scene.background)
    frame = np.random.default_rng(0).normal(frame, 0.5)
    all_of_them = detect_columns(frame, settings=SETTINGS)
    strong = detect_columns(frame, settings=ColumnSettings(spacing_px=SPACING, min_amplitude=0.5))
    assert strong.sizes["detection"] == len(scene.place) < all_of_them.sizes["detection"]


def test_the_spacing_is_measured_where_it_is_not_given(scene):
    found = detect_columns(scene.summed())
    assert found.attrs["spacing_px"] == pytest.approx(SPACING, rel=0.03)


def test_a_template_is_cut_where_it_is_named(scene):
    x, y = np.rint(scene.place[4]).astype(int)
    settings = ColumnSettings(spacing_px=SPACING, min_amplitude=0.5, template=(int(x), int(y)))
    found = detect_columns(scene.summed(), "template", settings=settings)
    missed, _ = misses(found_at(found), scene.place)
    assert missed.max() <= 1.0
    for at, match in (((1, 1), "no column to make the template"), ((3,), "needs x,y")):
        with pytest.raises(InputError, match=match):
            detect_columns(scene.summed(), "template", settings=ColumnSettings(spacing_px=SPACING, template=at))


def test_a_movie_is_searched_frame_by_frame(scene, tmp_path, npy):
    """Drift-corrected, the same for every frame as in the frame alone; nearly all columns, and hardly any other."""
    movie = movie_of(scene, tmp_path, npy)
    found = detect_columns(movie, settings=SETTINGS, drift=scene.drift_dataset())
    assert (np.diff(found.frame) >= 0).all()
    for k in range(scene.n_frames):
        here = found.sel(detection=found.frame == k)
        missed, wrong = misses(found_at(here), scene.place)
        assert (missed <= 2).mean() >= 0.95
        assert (wrong <= 2).mean() >= 0.95
        alone = detect_columns(movie.read(k, k + 1)[0], settings=SETTINGS)
        np.testing.assert_allclose(alone.x - scene.drift[k, 1], here.x, atol=1e-9)
        np.testing.assert_array_equal(alone.strength, here.strength)


def test_columns_that_come_late_are_added(scene, tmp_path, npy):
    """A column of a quarter of the frames: linked, numbered after the known ones, and its amplitude is what it has."""
    scene.n_frames = 16
    scene.__post_init__()
    late = 5
    present = np.ones((16, len(scene.place)), bool)
    present[:12, late] = False
    movie = movie_of(scene, tmp_path, npy, present)
    detections = detect_columns(movie, "blobs", settings=SETTINGS, drift=scene.drift_dataset())
    known = column_dataset(np.delete(scene.place, late, axis=0))
    seeds = link_detections(detections, min_share=0.2, columns=known)
    assert seeds.column_id.to_numpy()[-1] == len(scene.place) == seeds.sizes["column_id"]
    added = seeds.isel(column_id=-1)
    assert np.hypot(*(positions(seeds)[-1] - scene.place[late])) <= 0.5
    assert (float(added.share), int(added.first_frame), int(added.last_frame)) == (0.25, 12, 15)
    fresh = link_detections(detections, min_share=0.2)
    assert fresh.sizes["column_id"] == len(scene.place)
    image = np.mean([scene.frame(np.zeros(2), here) for here in present], axis=0)
    summed = scene.summed().assign(image=(("y", "x"), image))
    found = find_columns(summed, seeds=seeds, window_px=19).fit_ref.to_numpy()
    np.testing.assert_allclose(found[-1, AMPLITUDE], np.median(found[:-1, AMPLITUDE]), rtol=0.05)


def test_what_cannot_be_used_is_refused(scene):
    with pytest.raises(InputError, match="cannot be detected"):
        detect_columns(np.zeros((2, 3, 4)))
    with pytest.raises(SettingsError, match="no such choice"):
        detect_columns(scene.summed(), "guess")
    with pytest.raises(SettingsError, match="does not detect"):
        detect_columns(scene.summed(), "auto")
    with pytest.raises(InputError, match="no lattice"):
        detect_columns(np.random.default_rng(0).normal(size=(120, 120)))
    detections = detect_columns(scene.summed(), settings=SETTINGS)
    with pytest.raises(SettingsError, match="share"):
        link_detections(detections, min_share=0.0)


def test_nothing_is_found_in_nothing(tmp_path, npy, scene):
    """Frames without a finite pixel have no detections; no detections make no columns."""
    frames = np.full((3, 80, 80), np.nan, np.float32)
    frames[1] = 7.0
    made = convert(npy(frames, "empty.npy"), tmp_path / "empty.zarr", settings=ConvertSettings(tile_px=64))
    found = detect_columns(open_movie(made), settings=SETTINGS)
    assert found.sizes["detection"] == 0
    assert link_detections(found).sizes["column_id"] == 0
    assert isinstance(found, xr.Dataset)
