"""Columns found in images of known truth; lattices of three atoms; CSV files."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import xarray as xr
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tract_dask.errors import InputError, SettingsError, StoreError
from tract_dask.kernels.gaussian.parameters import PARAMETERS
from tract_dask.settings import ColumnSettings, from_toml, to_toml
from tract_dask.stages.columns.find import find_columns
from tract_dask.stages.columns.sites import lattice_columns
from tract_dask.stages.columns.twins import twins_of
from tract_dask.stages.columns.window_size import neighbour_distance
from tract_dask.store.columns import column_dataset, columns_csv, positions, read_columns_csv
from tract_dask.store.schema import COLUMNS, Status, validate

SHAPE = (200, 240)
SIGMA = 3.5
NOISE_FREE_BUDGET_PX = 0.05
NOISY_BUDGET_PX = 0.7

Places = np.ndarray[Any, Any]


def image_of(places: Places, heights: Places | float, shape: tuple[int, int] = SHAPE, sigma: float = SIGMA) -> Places:
    y, x = np.mgrid[: shape[0], : shape[1]]
    image = np.zeros(shape)
    for (cx, cy), height in zip(places, np.broadcast_to(heights, len(places)), strict=True):
        image += height * np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / (2 * sigma**2))
    return image


def summed(
    image: Places, exposure: Places | int = 40, noise: float = 0.0, pixel_size_pm: float | None = 4.0
) -> xr.Dataset:
    image = 10 + image + noise * np.random.default_rng(7).standard_normal(image.shape)
    return xr.Dataset(
        {"image": (("y", "x"), image), "exposure": (("y", "x"), np.broadcast_to(exposure, image.shape).astype("u4"))},
        attrs={"pixel_size_pm": pixel_size_pm},
    )


def crystal(
    angle: float = 0.0, spacing: float = 30.0, ratio: float = 1.2, shape: tuple[int, int] = SHAPE, offset: float = 0.3
) -> Places:
    """Sites of a rectangular lattice about the middle of the image, well inside it."""
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    i, j = np.mgrid[-9:10, -9:10].reshape(2, -1)
    places = (np.stack([i * spacing, j * spacing * ratio], axis=1) + offset) @ turn + np.array(shape[::-1]) / 2
    inside = ((places > 14) & (places < np.array(shape[::-1]) - 15)).all(axis=1)
    return places[inside]


def furthest(columns: xr.Dataset, truth: Places) -> float:
    """The distance from truth to the nearest column and back, at worst; they must be as many."""
    assert columns.sizes["column_id"] == len(truth)
    distance = np.hypot(*(positions(columns)[:, None] - truth).transpose(2, 0, 1))
    return max(distance.min(axis=0).max(), distance.min(axis=1).max())


# ---------------------------------------------------------------- automatic columns


@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_weak_columns_between_strong_ones_are_another_kind(angle: float) -> None:
    strong = crystal(angle)
    turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    weak = strong + np.array([15, 18]) @ turn
    weak = weak[((weak > 14) & (weak < np.array(SHAPE[::-1]) - 15)).all(axis=1)]
    image = image_of(strong, 5) + image_of(weak, 2)
    columns = find_columns(summed(image, noise=0.3))
    assert furthest(columns.where(columns.kind == "A", drop=True), strong) < NOISY_BUDGET_PX
    assert furthest(columns.where(columns.kind == "B", drop=True), weak) < 1.5 * NOISY_BUDGET_PX
    assert columns.attrs["lattice_px"] == pytest.approx(30, abs=0.2)
    assert columns.attrs["left_out"] == []


def test_a_single_sublattice_is_found_and_fitted() -> None:
    truth = crystal(0.1, ratio=1.0)
    columns = validate(find_columns(summed(image_of(truth, 5.0))), COLUMNS, "columns")
    assert furthest(columns, truth) < NOISE_FREE_BUDGET_PX
    fit = columns.fit_ref
    blurred = SIGMA**2 + 1.0**2
    np.testing.assert_allclose(fit.sel(parameter="amplitude"), 5 * SIGMA**2 / blurred, rtol=0.02)
    np.testing.assert_allclose(fit.sel(parameter="sigma_a"), np.sqrt(blurred), rtol=0.02)
    np.testing.assert_allclose(fit.sel(parameter="background"), 10, atol=0.05)
    np.testing.assert_array_equal(fit.sel(parameter="x"), columns.x_ref)
    np.testing.assert_array_equal(fit.sel(parameter="y"), columns.y_ref)


def test_dark_columns_are_the_bright_ones_of_the_negative() -> None:
    image = image_of(crystal(0.2), 5)
    bright = find_columns(summed(image))
    dark = find_columns(summed(-image), ColumnSettings(contrast="dark"))
    np.testing.assert_allclose(positions(dark), positions(bright), atol=1e-3)
    assert (dark.fit_ref.sel(parameter="amplitude") < 0).all()
    assert dark.attrs["contrast"] == "dark"


def test_vacancies_are_no_columns_and_weak_surface_columns_are() -> None:
    sites = crystal(0.0)
    heights = np.where(sites[:, 1] > 80, 5.0, 1.2)
    gone = [8, 17, 18]
    truth = np.delete(sites[sites[:, 1] > 45], gone, axis=0)
    image = image_of(truth, np.delete(heights[sites[:, 1] > 45], gone))
    assert furthest(find_columns(summed(image, noise=0.2)), truth) < NOISY_BUDGET_PX


def test_noise_in_vacuum_on_lattice_sites_is_not_taken() -> None:
    truth = crystal(0.0)
    truth = truth[truth[:, 1] > 110]
    assert furthest(find_columns(summed(image_of(truth, 5), noise=1.0)), truth) < 2 * NOISY_BUDGET_PX


def test_a_strong_column_off_the_lattice_is_kept_at_a_step_edge() -> None:
    lattice = crystal(0.0)
    lattice = lattice[lattice[:, 1] > 100]
    adatom = np.array([[lattice[:, 0].mean() + 9, lattice[:, 1].min() - 34]])
    truth = np.concatenate([lattice, adatom])
    assert furthest(find_columns(summed(image_of(truth, 5), noise=0.2)), truth) < NOISY_BUDGET_PX


def test_a_shifted_terrace_is_found_whole() -> None:
    left, right = crystal(0.0), crystal(0.0) + np.array([0, 11])
    truth = np.concatenate([left[left[:, 0] < 95], right[(right[:, 0] > 130) & (right[:, 1] < 185)]])
    assert furthest(find_columns(summed(image_of(truth, 5), noise=0.2)), truth) < NOISY_BUDGET_PX


def test_both_columns_of_a_dumbbell_are_found() -> None:
    one = crystal(0.2, spacing=40)
    truth = np.concatenate([one, one + np.array([14, 9])])
    truth = truth[((truth > 14) & (truth < np.array(SHAPE[::-1]) - 15)).all(axis=1)]
    heights = np.where(np.arange(len(truth)) < len(one), 5.0, 4.0)
    columns = find_columns(summed(image_of(truth, heights, sigma=3), noise=0.2))
    assert furthest(columns, truth) < NOISY_BUDGET_PX
    assert columns.attrs["spacing_px"] == pytest.approx(np.hypot(14, 9), abs=0.3)


def test_slow_distortion_is_followed() -> None:
    truth = crystal(0.0)
    truth = truth + 6 * np.sin(truth[:, ::-1] / 60)
    truth = truth[((truth > 14) & (truth < np.array(SHAPE[::-1]) - 15)).all(axis=1)]
    assert furthest(find_columns(summed(image_of(truth, 5), noise=0.2)), truth) < NOISY_BUDGET_PX


def test_a_speck_of_dirt_does_not_decide_the_sublattice() -> None:
    strong = crystal(0.0)
    weak = strong + np.array([15, 18])
    speck = np.argmin(np.hypot(*(weak - [120, 100]).T))
    heights = np.full(len(weak), 2.0)
    heights[speck] = 30.0
    columns = find_columns(summed(image_of(strong, 5) + image_of(weak, heights), noise=0.2))
    first, second = (columns.where(columns.kind == kind, drop=True) for kind in "AB")
    distance = np.hypot(*(positions(first)[:, None] - strong).transpose(2, 0, 1))
    assert (distance.min(axis=1) < NOISY_BUDGET_PX).all()
    assert (distance.min(axis=0) < NOISY_BUDGET_PX).sum() >= len(strong) - 4
    assert np.hypot(*(positions(second) - weak[speck]).T).min() < NOISY_BUDGET_PX, "a kind goes by the place"


def test_without_a_lattice_strong_peaks_are_found_when_the_spacing_is_given() -> None:
    truth = np.array(
        [[30, 40], [75, 52], [150, 33], [200, 77], [61, 120], [118, 101], [190, 150], [101, 160], [35, 171.0]]
    )
    image = summed(image_of(truth, 5), noise=0.2)
    with pytest.raises(InputError, match="Give spacing_px"):
        find_columns(image)
    columns = find_columns(image, ColumnSettings(spacing_px=30))
    assert furthest(columns, truth) < NOISY_BUDGET_PX


def test_a_given_spacing_is_used() -> None:
    truth = crystal(0.0)
    columns = find_columns(summed(image_of(truth, 5)), ColumnSettings(spacing_px=32))
    assert furthest(columns, truth) < NOISE_FREE_BUDGET_PX


def test_pixels_that_no_frame_covers_do_not_matter() -> None:
    truth = crystal(0.0)
    image = summed(image_of(truth, 5))
    exposure = np.full(SHAPE, 40)
    exposure[:, :4] = 0
    image["image"][:, :4] = np.nan
    image["exposure"] = (("y", "x"), exposure.astype("u4"))
    columns = find_columns(image)
    assert furthest(columns, truth) < NOISE_FREE_BUDGET_PX
    near = truth[:, 0] < 4 + columns.attrs["window_px"] // 2
    assert (columns.status_ref == Status.OUTSIDE_FRAME).sum() == near.sum()


@pytest.mark.parametrize("image", [np.zeros(SHAPE), np.random.default_rng(3).standard_normal(SHAPE)])
def test_where_there_is_nothing_the_error_says_what_to_do(image: Places) -> None:
    with pytest.raises(InputError, match=r"contrast"):
        find_columns(summed(image))


def test_the_wrong_contrast_with_a_spacing_names_the_contrast() -> None:
    with pytest.raises(InputError, match=r"darker than their surroundings.*now dark"):
        find_columns(summed(np.zeros(SHAPE)), ColumnSettings(contrast="dark", spacing_px=30))


def test_an_image_without_exposed_pixels_is_refused() -> None:
    with pytest.raises(InputError, match="empty"):
        find_columns(summed(np.zeros(SHAPE), exposure=0))


def test_another_dataset_is_refused() -> None:
    with pytest.raises(StoreError, match="exposure"):
        find_columns(summed(np.zeros(SHAPE)).drop_vars("exposure"))


# ---------------------------------------------------------------- numbering, edges, twins, attributes


def test_ids_run_by_rows_and_stay_with_columns_at_the_edge() -> None:
    truth = crystal(0.0) + [0.0, 1.0] * np.random.default_rng(1).uniform(-3, 3, (len(crystal(0.0)), 2))
    truth = np.concatenate([truth, [[4.0, truth[0, 1] + 1]]])  # in the first row, its window outside
    columns = find_columns(summed(image_of(truth, 5)))
    order = np.lexsort((truth[:, 0], np.rint((truth[:, 1] - truth[:, 1].min()) / 36)))
    np.testing.assert_array_equal(columns.column_id, np.arange(1, len(truth) + 1))
    np.testing.assert_allclose(positions(columns), truth[order], atol=1)
    assert columns.status_ref.values[0] == Status.OUTSIDE_FRAME
    assert np.isnan(columns.fit_ref.values[0]).all()
    assert (columns.status_ref.values[1:] == Status.OK).all()


def test_the_same_image_gives_the_same_columns() -> None:
    image = summed(image_of(crystal(0.3), 5), noise=0.5)
    xr.testing.assert_identical(find_columns(image), find_columns(image))


def test_attributes_say_how_the_columns_were_found() -> None:
    columns = find_columns(summed(image_of(crystal(), 5)), blur_sigma_px=1.0, window_px=15)
    attributes = columns.attrs
    assert (attributes["window_px"], attributes["blur_sigma_px"], attributes["pixel_size_pm"]) == (15, 1.0, 4.0)
    assert attributes["n_seeds"] == columns.sizes["column_id"]
    assert attributes["merged"] == []
    np.testing.assert_allclose(columns.fit_ref.sel(parameter="sigma_b"), np.hypot(SIGMA, 1), rtol=0.02)


@pytest.mark.parametrize(("sigma", "blur"), [(0.8, 0.0), (1.2, 0.5), (2.5, 1.0), (4.5, 2.0)])
def test_columns_are_found_at_every_sampling_with_a_blur_that_follows_them(sigma: float, blur: float) -> None:
    truth = crystal(0.2, 7.5 * sigma, 1.1)
    columns = find_columns(summed(image_of(truth, 5, sigma=sigma), noise=0.3))
    assert furthest(columns, truth) < 0.25 * sigma
    assert columns.attrs["blur_sigma_px"] == blur
    assert columns.attrs["sigma_px"] == pytest.approx(sigma, rel=0.03)
    assert ((columns["status_ref"] & int(Status.NOT_CONVERGED | Status.BELOW_NOISE)) == 0).all()


@pytest.mark.parametrize("window", [8, 3, 301])
def test_windows_that_cannot_be_used_are_refused(window: int) -> None:
    with pytest.raises(SettingsError, match="window_px"):
        find_columns(summed(image_of(crystal(), 5)), window_px=window)


def test_seeds_keep_their_ids_and_the_later_of_two_is_dropped() -> None:
    truth = crystal(0.0)[:6]
    seeds = column_dataset(np.concatenate([truth + 2, truth[:1] - 3]), "Ce", [9, 7, 100, 3, 5, 4, 12])
    columns = find_columns(summed(image_of(truth, 5)), seeds=seeds)
    np.testing.assert_array_equal(columns.column_id, [9, 7, 100, 3, 5, 4])
    assert columns.attrs["merged"] == [[9, 12]]
    assert (columns.kind == "Ce").all()
    assert furthest(columns, truth) < NOISE_FREE_BUDGET_PX


def test_the_first_of_places_that_fall_together_stays() -> None:
    """As all pairs say, which 100,000 places on one spot could not be asked for."""
    rng = np.random.default_rng(3)
    places = np.vstack([rng.uniform(0, 60, (150, 2)), rng.normal(30, 1, (100, 2)), np.full((20, 2), 7.5)])
    places = places[rng.permutation(len(places))]
    apart = np.linalg.norm(places[:, None] - places, axis=2)
    for distance in (1e-9, 0.7, 4.0, 100.0):
        expected: dict[int, int] = {}
        for place in range(len(places)):
            kept = [first for first in range(place) if first not in expected and apart[first, place] <= distance]
            if kept:
                expected[place] = kept[0]
        assert twins_of(places, distance) == expected
    began = time.monotonic()
    assert len(twins_of(np.full((100_000, 2), 12.25), 3.0)) == 99_999
    assert neighbour_distance(np.full((100_000, 2), 12.25)) is None
    assert time.monotonic() - began < 5


def test_places_on_one_spot_have_no_distance() -> None:
    assert neighbour_distance(np.array([[1.0, 2.0], [1.0, 2.0], [4.0, 6.0]])) is None  # more than half are at 0
    assert neighbour_distance(np.array([[1.0, 2.0], [1.0, 2.0], [4.0, 6.0], [4.0, 7.0], [4.0, 9.0]])) == 1.0


def test_dropping_a_seed_leaves_the_others_ids() -> None:
    truth = crystal(0.0)
    image = summed(image_of(truth, 5))
    seeds = column_dataset(truth)
    whole, part = find_columns(image, seeds=seeds), find_columns(image, seeds=seeds.drop_sel(column_id=[1, 4]))
    for column in part.column_id.values:
        assert abs(part.x_ref.sel(column_id=column) - whole.x_ref.sel(column_id=column)) < 1e-2


def test_a_weak_column_keeps_the_usual_shape() -> None:
    truth = crystal(0.0)
    heights = np.full(len(truth), 5.0)
    weak = int(np.argmin(np.hypot(*(truth - [120, 100]).T)))
    heights[weak] = 1.0
    cloud = image_of(truth[[weak]] + [13, 8], 0.8, sigma=8)
    columns = find_columns(summed(image_of(truth, heights) + cloud), seeds=column_dataset(truth))
    sigma_a = columns.fit_ref.sel(parameter="sigma_a").values
    assert sigma_a[weak] < 1.2 * np.median(sigma_a)
    assert columns.status_ref.values[weak] == Status.AT_BOUND
    assert np.hypot(*(positions(columns)[weak] - truth[weak])) < 3


def test_a_site_without_a_column_is_flagged_and_kept() -> None:
    truth = crystal(0.0)
    columns = find_columns(summed(image_of(truth[1:], 5), noise=0.3), seeds=column_dataset(truth))
    assert columns.sizes["column_id"] == len(truth)
    assert columns.status_ref.values[0] != Status.OK
    amplitude = columns.fit_ref.sel(parameter="amplitude").values
    assert amplitude[0] < 0.1 * np.median(amplitude)


def test_a_single_seed_needs_a_spacing_or_a_lattice() -> None:
    image = summed(image_of(np.array([[100.0, 90.0]]), 5), noise=0.1)
    seeds = column_dataset([[98, 91]])
    with pytest.raises(InputError, match="spacing_px"):
        find_columns(image, seeds=seeds)
    columns = find_columns(image, ColumnSettings(spacing_px=40), seeds=seeds)
    np.testing.assert_allclose(positions(columns), [[100, 90]], atol=NOISY_BUDGET_PX)


# ---------------------------------------------------------------- lattices of three atoms


numbers = st.floats(-500, 500, allow_subnormal=False)


@settings(max_examples=60)
@given(
    origin=st.tuples(numbers, numbers),
    length=st.tuples(st.floats(3, 50), st.floats(3, 50)),
    angle=st.floats(0, 6.3),
    between=st.floats(0.3, 2.8) | st.floats(-2.8, -0.3),
    counts=st.tuples(st.integers(1, 12), st.integers(1, 12)),
    repeats=st.tuples(st.integers(1, 9), st.integers(1, 9)),
)
def test_a_lattice_has_every_site_once(
    origin: tuple[float, float],
    length: tuple[float, float],
    angle: float,
    between: float,
    counts: tuple[int, int],
    repeats: tuple[int, int],
) -> None:
    step_a = length[0] * np.array([np.cos(angle), np.sin(angle)])
    step_b = length[1] * np.array([np.cos(angle + between), np.sin(angle + between)])
    a, b = origin + counts[0] * step_a, origin + counts[1] * step_b
    seeds = lattice_columns(origin, a.tolist(), counts[0], b.tolist(), counts[1], *repeats, kind="Ce")
    expected = [np.array(origin) + i * step_a + j * step_b for j in range(repeats[1]) for i in range(repeats[0])]
    np.testing.assert_allclose(positions(seeds), expected, atol=1e-8)
    np.testing.assert_array_equal(seeds.column_id, np.arange(1, repeats[0] * repeats[1] + 1))
    assert (seeds.kind == "Ce").all()


GOOD = {"origin": [30, 30], "a": [150, 30], "a_count": 4, "b": [30, 138], "b_count": 3, "a_repeats": 7, "b_repeats": 5}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"origin": [1, 2, 3]}, "origin is not a position"),
        ({"a": "here"}, "a is not a position"),
        ({"b": [1, float("nan")]}, "b is not a position"),
        ({"a_count": 0}, "a_count cannot be used"),
        ({"b_count": 2.5}, "b_count cannot be used"),
        ({"a_repeats": -3}, "a_repeats cannot be used"),
        ({"b_repeats": True}, "b_repeats cannot be used"),
        ({"kind": 7}, "kind cannot be used"),
        ({"b": [270, 30]}, "one line"),
        ({"b": [30, 30]}, "one line"),
        ({"c": 1}, "unknown c"),
    ],
)
def test_what_is_wrong_with_a_lattice_is_said(change: dict[str, Any], message: str) -> None:
    lattices = [GOOD, GOOD | change]
    with pytest.raises(SettingsError, match=rf"lattice 2: .*{message}|lattice 2: .*\. .*{message}"):
        find_columns(summed(np.zeros(SHAPE)), ColumnSettings(method="lattice", lattices=lattices))


def test_missing_keys_no_table_and_no_lattice_are_refused() -> None:
    for lattices, message in (([], "there is no lattice"), ([3], "not a table"), ([{"a": [1, 2]}], "without origin")):
        with pytest.raises(SettingsError, match=message):
            find_columns(summed(np.zeros(SHAPE)), ColumnSettings(method="lattice", lattices=lattices))


def test_lattices_from_toml_are_merged_and_sites_beyond_the_image_left_out() -> None:
    i, j = np.mgrid[:7, :5].reshape(2, -1)
    first = np.stack([30 + 30 * i, 30 + 36 * j], axis=1).astype(float)
    second = np.array([[45.0, 48.0], [75, 48], [105, 48]])
    text = """
    method = "lattice"
    [[lattices]]
    origin = [31, 29]
    a = [151, 29]
    a_count = 4
    b = [31, 139]
    b_count = 3
    a_repeats = 9
    b_repeats = 5
    kind = "Ce"
    [[lattices]]
    origin = [210, 174]
    a = [30, 174]
    a_count = 6
    b = [210, 30]
    b_count = 4
    a_repeats = 2
    b_repeats = 2
    kind = "again"
    [[lattices]]
    origin = [45, 48]
    a = [105, 48]
    a_count = 2
    b = [45, 84]
    b_count = 1
    a_repeats = 3
    kind = "O"
    """
    chosen = from_toml(ColumnSettings, text)
    assert from_toml(ColumnSettings, to_toml(chosen)) == chosen
    columns = find_columns(summed(image_of(first, 5) + image_of(second, 2)), chosen, window_px=15)
    assert columns.attrs["n_seeds"] == 5 * 7 + 4 + 3
    assert len(columns.attrs["merged"]) == 4
    assert dict(zip(*np.unique(columns.kind, return_counts=True), strict=True)) == {"Ce": 35, "O": 3}
    assert furthest(columns.where(columns.kind == "Ce", drop=True), first) < 0.3
    assert furthest(columns.where(columns.kind == "O", drop=True), second) < 1.0


def test_a_lattice_beyond_the_image_is_refused() -> None:
    away = GOOD | {"origin": [1000, 30], "a": [1100, 30], "b": [1000, 90]}
    with pytest.raises(SettingsError, match="no site of the lattices is inside"):
        find_columns(summed(np.zeros(SHAPE)), ColumnSettings(method="lattice", lattices=[away]))


# ---------------------------------------------------------------- CSV


def test_columns_from_a_csv_file(tmp_path: Path) -> None:
    truth = crystal(0.0)
    rows = [f"{100 - n}, {x + 1:.2f}, {y - 1:.2f}, {'A' if n % 2 else 'B'}" for n, (x, y) in enumerate(truth)]
    file = tmp_path / "seeds.csv"
    file.write_text("\ufeffcolumn_id, x, y, kind\n# chosen by hand\n\n" + "\n".join(rows) + "\n", encoding="utf-8")
    columns = find_columns(summed(image_of(truth, 5)), ColumnSettings(method="csv", csv=str(file)))
    np.testing.assert_array_equal(columns.column_id, 100 - np.arange(len(truth)))
    assert columns.kind.values[:2].tolist() == ["B", "A"]
    np.testing.assert_allclose(positions(columns), truth, atol=NOISE_FREE_BUDGET_PX)


def test_what_was_written_is_read_back_and_found_again(tmp_path: Path) -> None:
    image = summed(image_of(np.concatenate([crystal(), [[3.0, 100.0]]]), 5), noise=0.3)
    columns = find_columns(image)
    (tmp_path / "columns.csv").write_text(columns_csv(columns))
    read = read_columns_csv(tmp_path / "columns.csv")
    xr.testing.assert_identical(read, columns.drop_attrs(deep=False))
    again = find_columns(image, ColumnSettings(method="csv", csv=str(tmp_path / "columns.csv")))
    np.testing.assert_allclose(positions(again), positions(columns), atol=2e-2)
    np.testing.assert_array_equal(again.column_id, columns.column_id)


kinds = st.text(st.characters(codec="utf-8", exclude_categories=["C", "Z"]), max_size=8).map(lambda s: "k" + s)
finite = st.floats(-1e9, 1e9)


@settings(max_examples=50, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    rows=st.lists(st.tuples(finite, finite, kinds, st.booleans(), st.integers(0, 31), finite), min_size=1, max_size=12)
)
def test_any_columns_survive_a_csv_file(tmp_path: Path, rows: list[tuple[float, float, str, bool, int, float]]) -> None:
    fit = np.array([[v, x, y, v, v / 3, 0.1, v] if fitted else [np.nan] * 7 for x, y, _, fitted, _, v in rows])
    ids = np.random.default_rng(len(rows)).permutation(len(rows)) * 7
    columns = column_dataset([r[:2] for r in rows], [r[2] for r in rows], ids, fit, [r[4] for r in rows])
    (tmp_path / "c.csv").write_text(columns_csv(columns))
    xr.testing.assert_identical(read_columns_csv(tmp_path / "c.csv"), columns)
    assert fit.shape[1] == len(PARAMETERS)


@pytest.mark.parametrize(
    ("text", "place", "message"),
    [
        ("", "", "empty"),
        ("\n# nothing\n\n", "", "empty"),
        ("x,y\n", "", "empty"),
        ("a,b\n1,2\n", "line 1", "x and y"),
        ("1,2\n3,4\n", "line 1", "x and y"),
        ("x y\n1 2\n", "line 1", "separated by commas"),
        ("x,y\n1,2\n\n3,four\n", "line 4", "y cannot be read.*'four'"),
        ("x,y\n1,2\n3\n", "line 3", "fewer values than the first line names"),
        ("x,y\nnan,2\n", "line 2", "x cannot be read"),
        ("x,y\ninf,2\n", "line 2", "x cannot be read"),
        ("x,y,column_id\n1,2,1\n3,4,2\n5,6,1\n", "line 4", "comes twice.*1, as in line 2"),
        ("x,y,column_id\n1,2,1.5\n", "line 2", "column_id cannot be read.*whole number"),
        ("x,y,column_id\n1,2,-1\n", "line 2", "column_id cannot be read"),
        ("x,y,flags\n1,2,purple\n", "line 2", "flags cannot be read.*outside_frame"),
    ],
)
def test_what_is_wrong_with_a_file_is_said_with_its_line(tmp_path: Path, text: str, place: str, message: str) -> None:
    file = tmp_path / "bad.csv"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(SettingsError, match=message) as caught:
        read_columns_csv(file)
    assert "bad.csv" in caught.value.where
    assert place in caught.value.where


def test_a_file_that_is_not_there_or_not_text_is_refused(tmp_path: Path) -> None:
    (tmp_path / "image.csv").write_bytes(b"\x89PNG\xff\xfe\x00")
    for name in ("absent.csv", "image.csv"):
        with pytest.raises(SettingsError, match="cannot be read"):
            read_columns_csv(tmp_path / name)


def test_method_csv_needs_a_file() -> None:
    with pytest.raises(SettingsError, match="there is no file"):
        find_columns(summed(np.zeros(SHAPE)), ColumnSettings(method="csv"))


def test_seeds_outside_the_image_are_counted_and_the_first_is_named(tmp_path: Path) -> None:
    (tmp_path / "c.csv").write_text("column_id,x,y\n1,20,20\n2,20,220\n3,-7,20\n")
    with pytest.raises(SettingsError, match=r"2 of 3 columns lie outside.*y from 0 to 199.*column 2 at x 20, y 220"):
        find_columns(summed(np.zeros(SHAPE)), ColumnSettings(method="csv", csv=str(tmp_path / "c.csv")))


def test_columns_in_a_single_row_need_a_spacing() -> None:
    truth = np.stack([np.arange(25.0, 220, 30), np.full(7, 100.0)], axis=1)
    image = summed(image_of(truth, 5), noise=0.1)
    with pytest.raises(InputError, match="spacing_px"):
        find_columns(image)
    assert furthest(find_columns(image, ColumnSettings(spacing_px=30)), truth) < NOISY_BUDGET_PX


def test_seeds_whose_windows_all_leave_the_image_are_kept_without_fits() -> None:
    columns = find_columns(summed(image_of(crystal(), 5)), seeds=column_dataset([[2, 3], [40, 1], [80, 198]]))
    assert (columns.status_ref == Status.OUTSIDE_FRAME).all()
    np.testing.assert_array_equal(positions(columns), [[2, 3], [40, 1], [80, 198]])
    assert np.isnan(columns.fit_ref).all()
