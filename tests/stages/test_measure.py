"""The numbers of one shard against known truth."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import Scene

from tract_dask import accepted, convert, find_columns, fit_columns, open_movie, sum_image
from tract_dask.errors import SettingsError, StoreError
from tract_dask.kernels.gaussian.intensity import INTENSITY_SCALE, intensities
from tract_dask.settings import ColumnSettings, ConvertSettings, FitSettings, MetadataSettings
from tract_dask.stages.fit.frame_fits import FrameFits
from tract_dask.stages.fit.job import Job, prepare
from tract_dask.stages.fit.measure import measure
from tract_dask.stages.fit.vacuum import find_vacuum, why_unusable
from tract_dask.store.columns import column_dataset
from tract_dask.store.schema import Status
from tract_dask.store.shards import Shard

FREE = FitSettings(shape="free")


@pytest.fixture
def make_movie(tmp_path, npy):
    def make(frames, **metadata):
        store = convert(
            npy(frames),
            tmp_path / "movie.zarr",
            settings=ConvertSettings(tile_px=32),
            metadata=MetadataSettings(**metadata),
            overwrite=True,
        )
        return open_movie(store)

    return make


def position_bound(scene) -> float:
    """Standard deviation of a position by the Cramer-Rao bound (major axis), px: an upper bound."""
    signal = scene.amplitude**2 / (scene.background + scene.amplitude / 2)
    return float(scene.sigma_a / np.sqrt(np.pi * scene.sigma_a * scene.sigma_b * signal / 2))


def test_positions_and_shapes_match_the_truth(scene, make_movie):
    tracks = fit_columns(
        make_movie(scene.counts()), scene.columns(), scene.drift_dataset(), replace(FREE, refine_drift=False)
    ).compute()
    away = tracks.fit.sel(parameter=["x", "y"]).to_numpy() - scene.place
    assert away.std() <= 1.3 * position_bound(scene)
    assert np.abs(away.mean(axis=0)).max() <= 4 * position_bound(scene) / np.sqrt(scene.n_frames)
    widths = np.sqrt(np.array([scene.sigma_a, scene.sigma_b]) ** 2 + 1.0**2)  # the blur of 1 px adds its variance
    found = tracks.fit.sel(parameter=["sigma_a", "sigma_b"]).mean(("frame", "column_id")).to_numpy()
    np.testing.assert_allclose(found, widths, rtol=0.02)
    assert (tracks.status == 0).mean() > 0.99


@pytest.mark.parametrize("estimator", ["lsq", "poisson"])
def test_sums_by_whole_pixels_widen_no_column(make_movie, estimator):
    """At a sigma of 1 px a reference that is 1/12 px^2 wider makes intensities 4 % too large; here within 2 %."""
    scene = Scene(n_frames=40, shape=(128, 120), spacing=11.0, amplitude=600.0, sigma_a=1.0, sigma_b=1.0)
    movie, drift = make_movie(scene.counts()), scene.drift_dataset()
    summed = sum_image(movie, drift)
    columns = find_columns(summed, ColumnSettings(contrast="bright"), seeds=column_dataset(scene.place))
    assert summed.attrs["rounding_variance_px2"] == pytest.approx(1 / 12, rel=0.3)
    tracks = fit_columns(movie, columns, drift, FitSettings(estimator=estimator)).load()
    measured = float(tracks["intensity"].mean())
    assert measured == pytest.approx(INTENSITY_SCALE["paper"] * 2 * np.pi * 600.0, rel=0.02)


def test_centroids_are_nearly_as_good_as_fits(scene, make_movie):
    """Drift-corrected, unbiased, and at most 1.3 times the bound: a mask of the best radius loses 13 % at least."""
    tracks = fit_columns(
        make_movie(scene.counts()), scene.columns(), scene.drift_dataset(), FitSettings(refine_drift=False)
    ).compute()
    away = tracks.centroid.sel(axis=["x", "y"]).to_numpy() - scene.place
    assert away.std() <= 1.3 * position_bound(scene)
    assert np.abs(away.mean(axis=0)).max() <= 4 * position_bound(scene) / np.sqrt(scene.n_frames)
    assert away.std() >= (tracks.fit.sel(parameter=["x", "y"]).to_numpy() - scene.place).std()


def test_centroids_are_not_masked_but_where_there_is_no_window_or_frame(scene, make_movie):
    scene.drift[5] = (0, -18)
    frames = scene.counts().astype(np.float32)
    frames[7] = np.nan
    tracks = fit_columns(
        make_movie(frames), scene.columns(), scene.drift_dataset(), FitSettings(threshold=100, refine_drift=False)
    ).compute()
    masked = accepted(tracks)
    assert masked.fit.isnull().all()
    lost = (tracks.status.to_numpy() & (Status.OUTSIDE_FRAME | Status.BAD_FRAME)) > 0
    assert lost[5].any()
    assert lost[7].all()
    np.testing.assert_array_equal(masked.centroid.isnull().any("axis"), lost)


def test_dark_columns_have_centroids(scene, make_movie):
    scene.amplitude, scene.background = -60.0, 100.0
    tracks = fit_columns(make_movie(scene.counts()), scene.columns(), scene.drift_dataset()).compute()
    assert (tracks.centroid.sel(axis=["x", "y"]).to_numpy() - scene.place).std() <= 0.3


def test_a_small_mask_is_noisier(scene, make_movie):
    movie = make_movie(scene.counts())
    spread = {}
    for radius in (None, 3.0):
        settings = FitSettings(mask_radius_px=radius)
        tracks = fit_columns(
            movie, scene.columns(), scene.drift_dataset(), replace(settings, refine_drift=False)
        ).compute()
        spread[radius] = (tracks.centroid.sel(axis=["x", "y"]).to_numpy() - scene.place).std()
    assert spread[3.0] > 1.3 * spread[None]


def test_positions_do_not_depend_on_the_drift(scene, make_movie):
    """Windows move with the drift: a still scene and a drifting one give the same positions, noise-free, to 1e-3 px."""
    scene.drift = scene.drift + 0.37
    frames = np.array([scene.frame(shift) for shift in scene.drift], dtype=np.float32)
    tracks = fit_columns(
        make_movie(frames), scene.columns(), scene.drift_dataset(), FitSettings(refine_drift=False)
    ).compute()
    away = tracks.fit.sel(parameter=["x", "y"]).to_numpy() - scene.place
    assert np.abs(away).max() <= 1e-2  # neighbours' tails bias a column, the same in every frame
    assert away.std(axis=0).max() <= 1e-3


def test_common_motion_refines_the_drift(scene, make_movie):
    error = np.random.default_rng(3).normal(0, 0.5, (scene.n_frames, 2))
    tracks = fit_columns(
        make_movie(scene.counts()), scene.columns(), scene.drift_dataset(error), FitSettings(refine_columns=8)
    ).compute()
    left = tracks.drift.to_numpy() - scene.drift
    left -= left.mean(axis=0)
    assert left.std() <= 1.5 * position_bound(scene) / np.sqrt(len(scene.place))
    np.testing.assert_allclose(tracks.drift_measured, scene.drift + error)
    raw = tracks.fit.sel(parameter=["x", "y"]).to_numpy() + tracks.drift.to_numpy()[:, None, ::-1]
    assert (raw - scene.place - scene.drift[:, None, ::-1]).std() <= 1.3 * position_bound(scene)


def test_too_few_columns_leave_the_drift_alone(scene, make_movie):
    drift = scene.drift_dataset()
    tracks = fit_columns(
        make_movie(scene.counts()), scene.columns(), drift, FitSettings(refine_columns=len(scene.place) + 1)
    ).compute()
    np.testing.assert_array_equal(tracks.drift, drift.drift)


def test_absent_columns_are_flagged(scene, make_movie):
    present = np.ones((scene.n_frames, len(scene.place)), bool)
    present[3:7, 4] = False
    summed = scene.summed()
    movie = make_movie(scene.counts(present))
    tracks = fit_columns(
        movie, scene.columns(), scene.drift_dataset(), FitSettings(threshold=6, refine_drift=False), summed=summed
    ).compute()
    lost = tracks.status.to_numpy() != 0
    assert lost[~present].all()
    assert lost[present].mean() <= 0.01


def test_a_sigma_on_its_bound_is_flagged_and_accepted(scene, make_movie):
    columns = scene.columns()
    columns["fit_ref"][:, [3, 4]] *= 0.6  # the true widths are beyond 1.3 times these
    tracks = fit_columns(
        make_movie(scene.counts()), columns, scene.drift_dataset(), replace(FREE, refine_drift=False)
    ).compute()
    assert (tracks.status == Status.SHAPE_AT_BOUND).mean() > 0.95
    assert accepted(tracks).fit.sel(parameter="x").notnull().mean() > 0.95
    limit = 1.3 * float(columns["fit_ref"][0, 3])
    assert (tracks.fit.sel(parameter="sigma_a") <= limit * (1 + 1e-6)).all()


def test_noise_is_that_of_blurred_vacuum(scene, make_movie):
    """White noise of variance B, blurred with sigma s, has standard deviation sqrt(B) / (2 sqrt(pi) s)."""
    tracks = fit_columns(
        make_movie(scene.counts()), scene.columns(), scene.drift_dataset(), summed=scene.summed()
    ).compute()
    expected = np.sqrt(scene.background) / (2 * np.sqrt(np.pi) * 1.0)
    assert tracks.noise.mean().item() == pytest.approx(expected, rel=0.1)


def test_columns_that_leave_the_frame_keep_their_place_in_the_table(scene, make_movie):
    scene.drift[5] = (0, -18)
    tracks = fit_columns(
        make_movie(scene.counts()), scene.columns(), scene.drift_dataset(), FitSettings(refine_drift=False)
    ).compute()
    gone = scene.place[:, 0] - 18 < 19 // 2 - 0.5
    assert gone.any()
    outside = (tracks.status.to_numpy() & Status.OUTSIDE_FRAME) > 0
    np.testing.assert_array_equal(outside[5], gone)
    assert np.isnan(tracks.fit.to_numpy()[5, gone]).all()
    assert not outside[[0, 1, 2, 3, 4, 6, 7]].any()


def test_frames_without_numbers_are_bad_frames_and_the_rest_is_fitted(scene, make_movie):
    frames = scene.counts().astype(np.float32)
    x, y = np.rint(scene.place[2]).astype(int)
    frames[4, y, x] = np.nan
    frames[6] = np.inf
    tracks = fit_columns(make_movie(frames), scene.columns(), scene.drift_dataset(), summed=scene.summed()).compute()
    bad = (tracks.status.to_numpy() & Status.BAD_FRAME) > 0
    np.testing.assert_array_equal(bad.all(axis=1), np.isin(np.arange(scene.n_frames), [6]))
    assert (bad.any(axis=1) == bad.all(axis=1)).all()
    assert np.isfinite(tracks.fit.to_numpy()[4]).all()
    np.testing.assert_array_equal((tracks.status.to_numpy()[4] & Status.INCOMPLETE) > 0, np.arange(12) == 2)
    assert (tracks.status.to_numpy()[5] == 0).all()


def test_dark_columns_have_negative_amplitude_and_intensity(scene, make_movie):
    scene.amplitude, scene.background = -60.0, 100.0
    tracks = fit_columns(make_movie(scene.counts()), scene.columns(), scene.drift_dataset()).compute()
    assert (tracks.fit.sel(parameter="amplitude") < 0).all()
    assert (tracks.intensity < 0).all()
    away = tracks.fit.sel(parameter=["x", "y"]).to_numpy() - scene.place
    assert away.std() <= 0.25


def test_gain_turns_detector_units_into_counts(scene, make_movie):
    plain = fit_columns(make_movie(scene.counts()), scene.columns(), scene.drift_dataset()).compute()
    columns = scene.columns()
    columns["fit_ref"][:, [0, 6]] *= 3.0
    scaled = fit_columns(make_movie(scene.counts(), gain=3.0), columns, scene.drift_dataset()).compute()
    np.testing.assert_allclose(scaled.intensity, 3.0 * plain.intensity, rtol=1e-3)


@pytest.mark.parametrize(("scale", "share"), [("paper", 0.9545**2), ("ellipse", 1 - np.exp(-2))])
def test_intensity_is_the_integral_of_the_model(scale, share):
    """Equations 3 and 5 against numerical integration of Equation 1."""
    y, x = np.mgrid[-60:61, -60:61]
    amplitude, sigma_a, sigma_b, background = 5.0, 6.0, 4.0, 2.0
    total = (amplitude * np.exp(-0.5 * (x / sigma_a) ** 2 - 0.5 * (y / sigma_b) ** 2)).sum()
    estimates = np.array([amplitude, 0, 0, sigma_a, sigma_b, 0, background])
    intensity, error = intensities(estimates, scale)
    assert intensity == pytest.approx(share * total, rel=1e-6)
    assert error == pytest.approx(np.sqrt(intensity + 2 * background * np.pi * (2 * sigma_a) * (2 * sigma_b)))


def test_vacuum_is_found_above_the_crystal_and_not_inside_it(scene):
    y0, y1, x0, x1 = find_vacuum(scene.summed(), scene.columns(), 2.0)
    assert y1 <= scene.place[:, 1].min() - 2 * scene.sigma_a
    assert min(y1 - y0, x1 - x0) >= 24


def test_padding_is_no_vacuum(scene):
    summed = scene.summed()
    summed["image"] += np.random.default_rng(0).normal(0, 1, summed["image"].shape)
    padded = summed.pad(y=(0, 0), x=(0, 96), constant_values=0)  # a flat square larger than any of vacuum
    padded["exposure"][:] = summed["exposure"].max()
    y0, y1, x0, x1 = find_vacuum(padded, scene.columns(), 2.0)
    assert x1 <= summed.sizes["x"] + 1
    assert padded["image"][y0:y1, x0:x1].std() > 0


def test_vacuum_without_noise_is_vacuum(scene):
    summed = scene.summed()
    summed["image"][:64] = summed["image"][:24].mean()  # no edge
    y0, y1, x0, x1 = find_vacuum(summed, scene.columns(), 2.0)
    assert summed["image"][y0:y1, x0:x1].std() == 0


@pytest.mark.parametrize(
    ("kind", "said"),
    [("one value", "the value 7"), ("cut off", "was cut off"), ("hardly any", "counts a frame"), ("none", "no data")]
    + [(kind, None) for kind in ("counts", "low dose", "camera")],
)
def test_vacuum_that_does_not_tell_the_noise_is_not_used(kind, said):
    rng, shape = np.random.default_rng(1), (6, 60, 70)
    frames = {
        "one value": np.full(shape, 7.0),
        "cut off": np.maximum(rng.normal(0, 9, shape), 0),
        "hardly any": rng.poisson(1e-3, shape),
        "none": np.full(shape, np.nan),
        "counts": rng.poisson(20, shape),
        "low dose": rng.poisson(0.05, shape),
        "camera": np.rint(7.3 * rng.poisson(20, shape) + rng.normal(100, 5, shape)),
    }[kind]
    movie = SimpleNamespace(read=lambda start, stop, rows, columns: frames[start:stop, rows, columns])
    why = why_unusable(movie, (4, 40, 10, 60), np.full((6, 2), 1.6), np.ones(6, bool))
    assert said in why if said else why is None


def test_a_field_without_vacuum_takes_its_noise_from_the_residuals(scene, make_movie):
    left, top = scene.place.min(axis=0).astype(int)
    right, bottom = scene.place.max(axis=0).astype(int)
    crystal = scene.summed().isel(y=slice(top, bottom), x=slice(left, right))
    assert find_vacuum(crystal, scene.columns(), 2.0) is None
    tracks = fit_columns(make_movie(scene.counts()), scene.columns(), scene.drift_dataset()).compute()
    assert np.isfinite(tracks.noise).all()
    assert (tracks.noise < 0.2 * scene.amplitude).all()


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (FitSettings(window_px=20), "odd number"),
        (FitSettings(window_px=301), "odd number"),
        (FitSettings(vacuum_box=(0, 0, 10, 10)), "not a box"),
        (FitSettings(vacuum_box=(0, 20, 0, 20)), "leaves frame"),
    ],
)
def test_settings_that_cannot_work_are_refused_before_the_fits(scene, make_movie, settings, message):
    with pytest.raises(SettingsError, match=message):
        fit_columns(make_movie(scene.counts()), scene.columns(), scene.drift_dataset(), settings)


def test_fits_move_and_change_their_unit_without_a_trace_in_the_ones_before():
    windows = np.ones((2, 3))
    fits = FrameFits(
        **dict.fromkeys(("estimates", "stderr"), np.ones((2, 3, 7))),
        **dict.fromkeys(("volume_stderr", "strength", "residual", "ratio"), windows),
        **dict.fromkeys(("converged", "at_bound", "held", "incomplete"), windows > 0),
        r_squared=windows.astype("f4"),
        n_iterations=windows.astype("i2"),
        centroid=np.ones((2, 3, 2)),
    )
    outside = np.zeros((2, 3), bool)
    outside[0, 1] = True
    moved = fits.without(outside, np.array([False, True])).moved(np.array([10, 20])).scaled(4.0)
    assert moved.estimates[0, 0].tolist() == [4, 21, 11, 1, 1, 1, 4]
    assert moved.stderr[1, 2].tolist() == [4, 1, 1, 1, 1, 1, 4]
    assert moved.volume_stderr[1, 0] == 4
    assert np.isnan(moved.estimates[0, 1]).all()
    np.testing.assert_array_equal(np.isnan(moved.centroid).all(axis=-1), [[False, True, False], [True, True, True]])
    assert moved.centroid[0, 0].tolist() == [11, 21]
    assert moved.n_iterations.tolist() == [[1, 0, 1], [1, 1, 1]]
    assert all((values == 1).all() for values in vars(fits).values())


@pytest.mark.parametrize("filter_", ["gaussian", "none", "wiener"])
def test_a_single_frame_has_the_numbers_that_it_has_in_its_shard(scene, make_movie, filter_):
    movie = make_movie(scene.counts())
    columns, summed = scene.columns(), scene.summed()
    job = prepare(movie, columns, scene.drift_dataset(), FitSettings(filter=filter_), summed=summed)
    shard = measure(movie, movie.shards[0], job)
    frame = measure(movie, Shard(0, 1, 2), job, whole=True)
    for name, values in frame.items():
        np.testing.assert_array_equal(values[0], shard[name][1], err_msg=name)


@pytest.mark.parametrize("vacuum_box", [None, (2, 30, 2, 30)])
def test_a_job_is_the_same_after_it_was_saved(scene, make_movie, tmp_path, vacuum_box):
    movie = make_movie(scene.counts() * 1e-6)
    settings = FitSettings(vacuum_box=vacuum_box, refine_columns=7)
    job = prepare(movie, scene.columns(), scene.drift_dataset(), settings)
    job.save(tmp_path / "results.zarr", movie, "key")
    loaded = Job.load(tmp_path / "results.zarr", movie, "key")
    for name in ("window_px", "vacuum", "reference_blur_px", "refined_by", "settings", "unit"):
        assert getattr(loaded, name) == getattr(job, name), name
    for name in ("reference", "drift", "bad"):
        np.testing.assert_array_equal(getattr(loaded, name), getattr(job, name), err_msg=name)
    with pytest.raises(StoreError, match="other"):
        Job.load(tmp_path / "results.zarr", movie, "other")
