"""Numbers of atoms: the table against columns of known volume, counts and what they claim against known numbers."""

from __future__ import annotations

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from tract_dask import accepted, convert, fit_columns, open_movie
from tract_dask.analysis.intensity import normalised
from tract_dask.analysis.likelihood import CONFIDENCE, Levels, credible_sets, probabilities
from tract_dask.analysis.lookup import intensity_bound, look_up_table, read_table, write_table
from tract_dask.analysis.mixtures import mixture
from tract_dask.analysis.occupancy import _sigma, count_atoms, dose_to_be_sure
from tract_dask.errors import SettingsError
from tract_dask.kernels.gaussian import parameters
from tract_dask.settings import FitSettings, MetadataSettings
from tract_dask.store import schema
from tract_dask.store.columns import column_dataset

PIXEL_PM = 4.0
AREA = (PIXEL_PM / 100) ** 2
SIGMA = (4.0, 3.0)
AMPLITUDE = np.array([0.0, 0.8, 1.5, 2.0, 2.3, 2.4, 2.3, 2.0])
"""Of columns of 0 to 7 atoms, in units of the vacuum: rising to 5, then falling."""
INTENSITY = 0.9545**2 * 2 * np.pi * AMPLITUDE * SIGMA[0] * SIGMA[1] * AREA
PLACES = np.stack(np.meshgrid(np.arange(20.0, 140, 30), np.arange(20.0, 110, 30)), axis=-1).reshape(-1, 2) + 0.3
PAIRS = column_dataset(PLACES).assign(atoms=("column_id", np.full(len(PLACES), 2)))
SETTINGS = FitSettings(window_px=17)


def picture(amplitudes, shape=(130, 150), background=1.0):
    """Columns of these amplitudes at ``PLACES`` on a flat background."""
    y, x = np.mgrid[: shape[0], : shape[1]]
    image = np.full(shape, background)
    for (x0, y0), amplitude in zip(PLACES, amplitudes, strict=True):
        image += amplitude * np.exp(-0.5 * ((x - x0) / SIGMA[0]) ** 2 - 0.5 * ((y - y0) / SIGMA[1]) ** 2)
    return image


def pictures(numbers=range(1, 8), spread=0.0):
    """An image for each number; its columns are brighter or darker by up to ``spread``."""
    factors = 1 + spread * np.linspace(-1, 1, len(PLACES))
    return np.array([picture(AMPLITUDE[n] * factors) for n in numbers])


def given_table(spread=0.0, atoms=range(1, 8), **attributes):
    """The true table, with sites that spread by this share."""
    numbers = np.array(atoms)
    values = {"intensity": INTENSITY, "low": (1 - spread) * INTENSITY, "high": (1 + spread) * INTENSITY}
    return xr.Dataset({k: ("atoms", v[numbers]) for k, v in values.items()}, {"atoms": numbers}, attributes)


def given_tracks(numbers, relative_error, n_frames=400, seed=0, vacuum=5.0, threshold=0.0):
    """Tracks of columns with these numbers of atoms, whose intensities have a known error; no pixel is fitted."""
    rng = np.random.default_rng(seed)
    to_counts = vacuum / AREA
    mean = INTENSITY[numbers] * to_counts
    sigma = np.full(len(numbers), relative_error * INTENSITY[3] * to_counts)
    drawn = rng.normal(np.sqrt(mean**2 + 2 * sigma**2), sigma, (n_frames, len(numbers)))
    empty = np.asarray(numbers) == 0
    drawn[:, empty] = rng.normal(1.65, 0.62, (n_frames, empty.sum())) * sigma[empty]
    reference = np.zeros((len(numbers), 7))
    reference[:, 0], reference[:, 3:5], reference[:, 6] = AMPLITUDE[3] * vacuum, SIGMA, vacuum
    per_amplitude = 0.9545**2 * 2 * np.pi * SIGMA[0] * SIGMA[1]
    noise = np.ones(n_frames)
    fit = np.broadcast_to(reference, (n_frames, *reference.shape)).copy()
    fit[..., 0] = drawn / per_amplitude
    weak = fit[..., 0] < threshold * noise[:, None]
    each = ("frame", "column_id")
    return xr.Dataset(
        {
            "fit": ((*each, "parameter"), fit),
            "stderr": ((*each, "parameter"), np.ones_like(fit)),
            "intensity": (each, drawn),
            "intensity_error": (each, np.broadcast_to(sigma, drawn.shape).copy()),
            "intensity_stderr": (each, np.broadcast_to(sigma, drawn.shape).copy()),
            "status": (each, weak.astype(np.uint16)),
            "noise": ("frame", noise),
            "fit_ref": (("column_id", "parameter"), reference),
        },
        {"column_id": np.arange(1, len(numbers) + 1), "parameter": list(parameters.PARAMETERS)},
        {
            "pixel_size_pm": PIXEL_PM,
            "window_px": 17,
            "window_blur_px": 0.0,
            "reference_blur_px": 0.0,
            "shape": "free",
            "estimator": "lsq",
            "intensity_scale": "paper",
        },
    )


def members(counts, level=0.95):
    """Which numbers belong to the smallest set that holds ``level``; a plain loop."""
    probability = counts["probability"].to_numpy()
    inside = np.zeros(probability.shape, bool)
    for place in np.ndindex(probability.shape[:-1]):
        held = 0.0
        for k in np.argsort(-probability[place], kind="stable"):
            inside[(*place, k)] = True
            held += probability[(*place, k)]
            if held >= level:
                break
    return inside


def share_inside(counts, truth, level=0.95):
    """Share of the sets that hold the truth, and the probability that they claim."""
    inside = members(counts, level)
    index = np.broadcast_to(np.searchsorted(counts["n_atoms"], truth), inside.shape[:-1])
    held = np.take_along_axis(inside, index[..., None], axis=-1)
    return held.mean(), (counts["probability"].to_numpy() * inside).sum(axis=-1).mean()


# the table


@pytest.mark.parametrize("estimator", ["lsq", "poisson"])
@pytest.mark.parametrize("shape", ["fixed", "free"])
def test_the_table_holds_the_volumes_of_the_columns(estimator, shape):
    settings = FitSettings(window_px=17, estimator=estimator, shape=shape)
    table = look_up_table(3 * pictures(), column_dataset(PLACES), settings, pixel_size_pm=PIXEL_PM, vacuum=3.0)
    np.testing.assert_array_equal(table["atoms"], np.arange(1, 8))
    np.testing.assert_allclose(table["intensity"], INTENSITY[1:], rtol=2e-3)
    np.testing.assert_allclose(table["high"] / table["low"], 1, atol=4e-3)


def test_low_and_high_are_the_range_over_the_sites():
    table = look_up_table(pictures([2, 3], 0.04), column_dataset(PLACES), SETTINGS, pixel_size_pm=PIXEL_PM)
    np.testing.assert_allclose(table["low"], 0.96 * INTENSITY[[2, 3]], rtol=3e-3)
    np.testing.assert_allclose(table["high"], 1.04 * INTENSITY[[2, 3]], rtol=3e-3)
    assert table["site_intensity"].dims == ("atoms", "site")
    np.testing.assert_allclose(table["site_intensity"].mean("site"), table["intensity"])


def test_the_scale_is_that_of_the_fit():
    paper, ellipse = (
        look_up_table(
            pictures([3]),
            column_dataset(PLACES),
            FitSettings(window_px=17, intensity_scale=scale),
            pixel_size_pm=PIXEL_PM,
        )
        for scale in ("paper", "ellipse")
    )
    np.testing.assert_allclose(ellipse["intensity"] / paper["intensity"], (1 - np.exp(-2)) / 0.9545**2)


def test_dark_columns_have_negative_intensities():
    image = np.array([picture(np.full(len(PLACES), -0.4))])
    table = look_up_table(image, column_dataset(PLACES), SETTINGS, pixel_size_pm=PIXEL_PM, contrast="dark")
    np.testing.assert_allclose(table["intensity"], -0.4 / AMPLITUDE[3] * INTENSITY[3], rtol=3e-3)


def test_a_scene_with_a_step_says_how_many_atoms_each_column_has():
    numbers = np.tile([1, 2, 3], 4)
    scene = column_dataset(PLACES).assign(atoms=("column_id", numbers))
    table = look_up_table(picture(AMPLITUDE[numbers])[None], scene, SETTINGS, pixel_size_pm=PIXEL_PM)
    np.testing.assert_allclose(table["intensity"], INTENSITY[1:4], rtol=3e-3)
    assert (table["site_intensity"].notnull().sum("site") == 4).all()


def test_a_site_without_a_column_is_left_out():
    amplitudes = np.full(len(PLACES), AMPLITUDE[2])
    amplitudes[5] = -0.5
    table = look_up_table(picture(amplitudes)[None], column_dataset(PLACES), SETTINGS, pixel_size_pm=PIXEL_PM)
    assert "6" not in table["site"].values
    assert table.sizes["site"] == len(PLACES) - 1
    np.testing.assert_allclose(table["intensity"], INTENSITY[1:2] * AMPLITUDE[2] / AMPLITUDE[1], rtol=5e-3)


def test_variances_are_equation_5_and_the_bound():
    table = look_up_table(
        pictures([3]), column_dataset(PLACES), FitSettings(window_px=17, blur_sigma_px=0), pixel_size_pm=4
    )
    product = SIGMA[0] * SIGMA[1] * AREA
    np.testing.assert_allclose(table["variance_poisson"], INTENSITY[3] + 8 * np.pi * product, rtol=5e-3)
    dose = 500.0
    electrons = np.array([[AMPLITUDE[3] * dose * AREA, 8, 8, *SIGMA, 0, dose * AREA]])
    stderr = intensity_bound(electrons, 17, fixed_shape=True)[0] * INTENSITY[3]
    np.testing.assert_allclose(table["variance_fit"] / dose, stderr**2, rtol=1e-2)


def test_tables_survive_csv(tmp_path):
    table = look_up_table(pictures([1, 2], 0.03), column_dataset(PLACES), SETTINGS, pixel_size_pm=PIXEL_PM)
    write_table(table, tmp_path / "table.csv")
    xr.testing.assert_allclose(read_table(tmp_path / "table.csv"), table, rtol=1e-8)


def test_a_table_may_be_written_by_hand(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("atoms,intensity\n1,0.32\n2,0.63\n")
    table = read_table(path)
    np.testing.assert_array_equal(table["low"], [0.32, 0.63])
    path.write_text("atoms,intensity,site\n1,0.32,a\n1,0.34,b\n")
    table = read_table(path)
    assert (table["low"].item(), table["high"].item()) == (0.32, 0.34)
    assert table["intensity"].item() == pytest.approx(0.33)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("number,intensity\n1,2\n", "not a look-up table"),
        ("atoms,intensity\n", "not a look-up table"),
        ("atoms,intensity\n1,0.3\n2,bright\n", "line 3"),
        ("atoms,intensity\n0,0.3\n", "line 2"),
        ("atoms,intensity\n1,\n", "line 2"),
        ("atoms,intensity,site\n1,0.3,a\n1,0.4,a\n", "occurs twice"),
    ],
)
def test_what_is_no_table_is_refused(tmp_path, text, message):
    path = tmp_path / "table.csv"
    path.write_text(text)
    with pytest.raises(SettingsError, match=message):
        read_table(path)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pixel_size_pm": None}, "size of a pixel"),
        ({"settings": FitSettings(filter="wiener")}, "this filter"),
        ({"columns": [column_dataset(PLACES)] * 2}, "do not go together"),
        ({"columns": column_dataset(PLACES[:1]), "settings": None}, "One column|one column"),
        ({"images": np.ones((1, 130, 150))}, "could be measured|stands out"),
        (
            {
                "columns": [column_dataset(PLACES).assign(atoms=("column_id", np.full(12, 2)))] * 2,
                "images": pictures([2, 2]),
            },
            "occurs twice",
        ),
    ],
)
def test_images_that_make_no_table_are_refused(change, message):
    arguments = {"images": pictures([2]), "columns": column_dataset(PLACES), "settings": SETTINGS, "pixel_size_pm": 4.0}
    with pytest.raises(SettingsError, match=message):
        look_up_table(**arguments | change)


# counting


@pytest.mark.parametrize("relative_error", [0.03, 0.1, 0.3])
def test_sets_hold_the_truth_as_often_as_they_claim(relative_error):
    numbers = np.tile([0, 1, 2, 3, 4, 5, 6, 7], 4)
    counts = count_atoms(given_tracks(numbers, relative_error), given_table(), 5.0, table_error=0)
    for level in CONFIDENCE:
        share, claimed = share_inside(counts, numbers, level)
        assert claimed >= level
        assert share == pytest.approx(claimed, abs=0.01)
    np.testing.assert_allclose(counts["probability"].sum("n_atoms"), 1, atol=1e-5)


def test_the_table_s_own_error_counts():
    """Columns whose intensities differ from the table's by what it says of itself."""
    numbers = np.tile([1, 2, 3, 4], 100)
    rng = np.random.default_rng(3)
    tracks = given_tracks(numbers, 0.002, n_frames=2)
    tracks["intensity"] = tracks["intensity"] * (1 + rng.normal(0, 0.08, len(numbers)))
    honest, claimed = share_inside(count_atoms(tracks, given_table(spread=0.08), 5.0, table_error=0), numbers)
    assert honest == pytest.approx(claimed, abs=0.02)
    naive, claimed = share_inside(count_atoms(tracks, given_table(), 5.0, table_error=0), numbers)
    assert naive < claimed - 0.02
    same = count_atoms(tracks, given_table(), 5.0, table_error=0.08)
    np.testing.assert_allclose(
        same["probability"], count_atoms(tracks, given_table(0.08), 5.0, table_error=0)["probability"]
    )


def test_the_mean_of_the_frames_counts_better():
    numbers = np.tile([1, 2, 3], 4)
    tracks = given_tracks(numbers, 0.2, n_frames=100)
    each = count_atoms(tracks, given_table(), 5.0, max_atoms=4)
    mean = count_atoms(tracks, given_table(), 5.0, max_atoms=4, frames="mean")
    assert (each["atoms"] == numbers).mean() < 0.9
    np.testing.assert_array_equal(mean["atoms"], numbers)
    assert mean["atoms"].dims == ("column_id",)


def test_faint_frames_that_were_not_accepted_do_not_make_the_mean_too_bright():
    numbers = np.repeat([1, 2], 30)
    tracks = given_tracks(numbers, 0.3, n_frames=400, threshold=5.0)
    seen = accepted(tracks)["intensity"]
    assert 0.3 < seen[:, :30].isnull().mean() < 0.9
    counts = count_atoms(tracks, given_table(), 5.0, frames="mean", max_atoms=4, threshold=5.0, table_error=0)
    np.testing.assert_array_equal(counts["atoms"], numbers)
    unaware = count_atoms(tracks, given_table(), 5.0, frames="mean", max_atoms=4, threshold=0.0, table_error=0)
    assert (unaware["atoms"][:30] != 1).any()


def test_columns_that_are_not_there_have_no_atoms():
    numbers = np.array([0, 0, 1, 3])
    vacuum = 60.0
    reference = np.array([[AMPLITUDE[3] * vacuum, 8, 8, *SIGMA, 0, vacuum]])
    error = intensity_bound(reference, 17, fixed_shape=False).item()
    tracks = given_tracks(numbers, error, vacuum=vacuum, threshold=14.0)
    assert (tracks["status"].mean("frame") > [0.5, 0.5, -1, -1]).all()
    for source in (tracks, accepted(tracks)):
        counts = count_atoms(source, given_table(), vacuum, threshold=14.0)
        assert (counts["atoms"] == numbers).mean("frame").values.min() > 0.8


def test_what_the_fit_does_not_know_is_not_counted():
    tracks = given_tracks(np.array([1, 2, 3]), 0.05, n_frames=3)
    status = tracks["status"].to_numpy()
    status[0] = schema.Status.OUTSIDE_FRAME, schema.Status.BAD_FRAME, schema.Status.AT_BOUND
    counts = count_atoms(tracks, given_table(), 5.0)
    assert counts[["atoms", "low_68", "high_95", "probability"]].isel(frame=0).isnull().all().to_array().all()
    assert not counts["ambiguous"].isel(frame=0).any()
    assert counts["atoms"].isel(frame=slice(1, None)).notnull().all()


def test_ambiguity_past_the_maximum_is_said():
    numbers = np.array([1, 4, 5, 6])
    tracks = given_tracks(numbers, 0.02, n_frames=50)
    whole = count_atoms(tracks, given_table(), 5.0)
    assert whole["ambiguous"].mean("frame").values.tolist() == pytest.approx([0, 1, 1, 1], abs=0.35)
    assert (whole["low_95"] <= numbers).all()
    assert (whole["high_95"] >= numbers).all()
    rising = count_atoms(tracks.isel(column_id=[0, 1]), given_table(), 5.0, max_atoms=5)
    assert not rising["ambiguous"].any()
    assert int(rising["n_atoms"].max()) == 5


def test_a_set_with_a_gap_is_ambiguous():
    probability = np.array([[0.0, 0.0, 0.0, 0.5, 0.0, 0.0, 0.5], [0.0, 0.1, 0.9, 0.0, 0.0, 0.0, 0.0]], np.float32)
    atoms, _, _, low, high, ambiguous = credible_sets(probability, numbers=np.arange(7), brightest=6)
    assert (atoms.tolist(), low.tolist(), high.tolist()) == ([3, 2], [3, 1], [6, 2])
    assert ambiguous.tolist() == [True, False]


def test_a_user_s_prior_and_noise_enter():
    tracks = given_tracks(np.full(5, 5), 0.05, n_frames=20)
    table = given_table()
    flat = count_atoms(tracks, table, 5.0, error="stderr")
    sure = count_atoms(tracks, table, 5.0, prior=[0, 0, 0, 0, 0, 1, 0, 0])
    assert (sure["probability"].sel(n_atoms=5) == 1).all()
    wide = count_atoms(tracks, table, 5.0, noise_scale=3.0, error="stderr")
    assert ((wide["high_95"] - wide["low_95"]).mean() > (flat["high_95"] - flat["low_95"]).mean()).item()
    repeated = count_atoms(tracks, table, 5.0, error="repeated")
    assert float(abs(repeated["probability"] - flat["probability"]).mean()) < 0.03
    tracks["intensity_error"] = 3 * tracks["intensity_stderr"]
    poisson = count_atoms(tracks, table, 5.0, error="poisson")
    np.testing.assert_allclose(poisson["probability"], wide["probability"], atol=1e-5)


def test_the_scatter_of_the_frames_is_the_default_error():
    """Stated errors that are half the true ones: sets hold the truth by the scatter; by what fits state they do not.

    A column that loses atoms half-way keeps its error. With few frames, or few accepted ones, stated errors do.
    """
    numbers = np.repeat([2, 3, 4], 14)
    tracks = given_tracks(numbers, 0.08)
    tracks["intensity_stderr"] = tracks["intensity_stderr"] / 2
    table = given_table()
    honest, claimed = share_inside(count_atoms(tracks, table, 5.0, table_error=0), numbers)
    assert honest >= claimed - 0.02
    stated, _ = share_inside(count_atoms(tracks, table, 5.0, table_error=0, error="stderr"), numbers)
    assert stated < honest - 0.03
    measured = normalised(tracks, 5.0)
    ratio = _sigma(measured, "scatter") / (2 * measured["intensity_stderr"])
    np.testing.assert_allclose(ratio.median("frame"), 1.0, atol=0.15)
    falls = tracks.assign(intensity=tracks["intensity"].where(tracks["frame"] < 200, 0.5 * tracks["intensity"]))
    np.testing.assert_allclose(
        _sigma(normalised(falls, 5.0), "scatter")[0] / _sigma(measured, "scatter")[0], 0.75, atol=0.05
    )
    short = normalised(tracks.isel(frame=slice(8)), 5.0)
    np.testing.assert_array_equal(_sigma(short, "scatter"), short["intensity_stderr"])


def test_the_error_of_a_shape_that_all_frames_share_stays_in_the_mean():
    tracks = given_tracks(np.full(200, 3), 0.05, n_frames=50)
    table = given_table()
    free = count_atoms(tracks, table, 5.0, frames="mean", table_error=0)
    shared = tracks.assign(shape_error=("column_id", np.full(200, 0.5))).assign_attrs(shape="fixed")
    held = count_atoms(shared, table, 5.0, frames="mean", table_error=0)
    assert (held["probability"].max("n_atoms") < free["probability"].max("n_atoms")).all()


def test_lazy_tracks_stay_lazy_and_give_the_same():
    tracks = given_tracks(np.array([0, 1, 3, 5, 7]), 0.1, threshold=2.0)
    lazy = tracks.chunk({"frame": 100})
    for frames in ("each", "mean"):
        counts = count_atoms(lazy, given_table(), xr.DataArray(np.full(400, 5.0), dims="frame"), frames=frames)
        assert all(counts[name].chunks for name in counts)
        xr.testing.assert_allclose(counts.compute(), count_atoms(tracks, given_table(), 5.0, frames=frames), atol=1e-5)


def test_windows_of_another_size_make_a_table_less_sure():
    tracks = given_tracks(np.array([3]), 0.001).assign_attrs(window_px=17)
    alike, narrower = (given_table(window_pm=4.0 * window) for window in (17, 15.5))
    sure, unsure = (count_atoms(tracks, table, 5.0) for table in (alike, narrower))
    stated = count_atoms(tracks, alike, 5.0, table_error=float(np.hypot(0.01, 0.5 * (17 / 15.5 - 1))))
    xr.testing.assert_allclose(unsure, stated)
    assert float(unsure["probability"].sel(n_atoms=3).mean()) < float(sure["probability"].sel(n_atoms=3).mean())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"frames": "some"}, "frames cannot be used"),
        ({"error": "none"}, "error cannot be used"),
        ({"max_atoms": -1}, "no number of atoms"),
        ({"prior": [1, 2]}, "prior cannot be used"),
        ({"table": given_table(estimator="poisson")}, "another estimator"),
        ({"table": given_table(window_pm=100.0)}, "another window"),
    ],
)
def test_arguments_that_cannot_be_used_are_refused(change, message):
    arguments = {"tracks": given_tracks(np.array([1]), 0.1, 2), "table": given_table(), "vacuum": 5.0}
    with pytest.raises(SettingsError, match=message):
        count_atoms(**arguments | change)


def test_counting_movies(tmp_path, npy):
    """From pixels to numbers: a table of noise-free images, a movie of counts, every column right in the mean."""
    numbers = np.tile([1, 2, 3, 4], 3)
    vacuum = 6.0
    rng = np.random.default_rng(5)
    frames = rng.poisson(np.broadcast_to(vacuum * picture(AMPLITUDE[numbers]), (24, 130, 150))).astype(np.uint16)
    movie = open_movie(convert(npy(frames), tmp_path / "movie.zarr", metadata=MetadataSettings(pixel_size_pm=4.0)))
    truth = np.zeros((len(PLACES), 7))
    truth[:, 1:3], truth[:, 3:5], truth[:, 6] = PLACES, np.hypot(SIGMA, 2.0), vacuum
    truth[:, 0] = vacuum * AMPLITUDE[numbers] * np.prod(SIGMA) / truth[:, 3:5].prod(axis=1)
    columns = column_dataset(PLACES, fit=truth).assign_attrs(window_px=17, blur_sigma_px=2.0)
    tracks = fit_columns(movie, columns, settings=SETTINGS)
    table = look_up_table(pictures(), column_dataset(PLACES), SETTINGS, pixel_size_pm=4.0)
    each = count_atoms(tracks, table, vacuum, max_atoms=5).compute()
    share, claimed = share_inside(each, numbers)
    assert share == pytest.approx(claimed, abs=0.03)
    assert (abs(each["atoms"] - numbers) <= 1).mean() > 0.95
    mean = count_atoms(tracks, table, vacuum, max_atoms=5, frames="mean").compute()
    np.testing.assert_array_equal(mean["atoms"], numbers)


# how sure, at which dose


def test_the_dose_to_be_sure_is_that_of_the_closed_form():
    variance = np.full(7, 3.0)
    table = given_table().assign(variance_poisson=("atoms", variance))
    found = dose_to_be_sure(table, max_atoms=4)
    steps = np.diff(INTENSITY[:5])
    smallest = np.minimum(steps, np.append(steps[1:], np.inf))
    np.testing.assert_allclose(found["dose"], 3.0 / (smallest / stats.norm.ppf(0.975)) ** 2)
    np.testing.assert_allclose(dose_to_be_sure(table, 2, max_atoms=4, noise_scale=2.0)["dose"], 4 * found["dose"][1:2])
    near = dose_to_be_sure(table, 2, within=1, max_atoms=4)
    np.testing.assert_allclose(near["step"], INTENSITY[4] - INTENSITY[2])
    assert np.isinf(dose_to_be_sure(table, 4)["dose"]).all()  # 6 atoms are as bright
    assert np.isinf(dose_to_be_sure(table, 3, max_atoms=4, table_error=0.2)["dose"]).all()


def test_at_that_dose_counts_are_sure():
    """A column that is seen with that error is told from its neighbours in 95 of 100 frames."""
    table = given_table().assign(variance_poisson=("atoms", np.full(7, 3.0)))
    dose = dose_to_be_sure(table, 3, max_atoms=4)["dose"].item()
    tracks = given_tracks(np.full(20, 3), np.sqrt(3.0 / dose) / INTENSITY[3])
    counts = count_atoms(tracks, table, 5.0, max_atoms=4, table_error=0)
    assert (counts["atoms"] == 3).mean() > 0.7
    beyond = abs(tracks["intensity"] * AREA / 5.0 - INTENSITY[3]) > INTENSITY[4] - INTENSITY[3]
    assert float(beyond.mean()) == pytest.approx(0.05, abs=0.02)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"error": "fit"}, "vary with dose"),
        ({"confidence": 1.0}, "confidence"),
        ({"n": 9}, "lacks this number"),
        ({"error": "stderr"}, "error cannot be used"),
    ],
)
def test_doses_that_cannot_be_told_are_refused(arguments, message):
    table = given_table().assign(variance_poisson=("atoms", np.full(7, 3.0)))
    with pytest.raises(SettingsError, match=message):
        dose_to_be_sure(table, **arguments)


# arithmetic


def test_means_above_a_threshold_are_scipy_s():
    at = np.array([8.0, 11.0, 14.0])
    mean, sigma = np.sqrt(100 + 2 * 4.0), 2.0
    cut = stats.truncnorm((at - mean) / sigma, np.inf, mean, sigma)
    both = Levels(np.array([1, 2]), np.array([10.0, 10.0]), np.zeros(2), np.log([0.5, 0.5]))
    assert probabilities(at, sigma, at, np.zeros(3, bool), 1.0, 0.0, levels=both, chosen=True) == pytest.approx(0.5)
    seen = cut.mean() + np.array([[0.0], [1.0]])
    other = Levels(np.array([1, 2]), np.array([10.0, 12.0]), np.zeros(2), np.log([0.5, 0.5]))
    found = probabilities(seen, sigma, at, np.zeros(3, bool), 50.0, 0.0, levels=other, chosen=True)
    above = stats.truncnorm((at - np.sqrt(144 + 8)) / sigma, np.inf, np.sqrt(144 + 8), sigma)
    first, second = (stats.norm.pdf(seen, c.mean(), c.std() / np.sqrt(50)) for c in (cut, above))
    np.testing.assert_allclose(found[..., 0], first / (first + second), atol=1e-4)


# without a table


def scattered(width, sizes=(30, 50, 80, 40), seed=0):
    truth = np.repeat(np.arange(1, len(sizes) + 1), sizes)
    values = INTENSITY[truth] + np.random.default_rng(seed).normal(0, width, len(truth))
    return xr.DataArray(values, dims="column_id", attrs={"units": "vacuum A^2"}), truth


@pytest.mark.parametrize("seed", range(3))
def test_a_mixture_finds_the_groups(seed):
    step = INTENSITY[4] - INTENSITY[3]
    values, truth = scattered(step / 5, seed=seed)
    groups = mixture(values)
    assert groups.sizes["component"] == 4
    error = groups["location_stderr"].to_numpy()
    assert (abs(groups["location"] - INTENSITY[1:5]) < 5 * error).all()
    assert groups["width"].item() == pytest.approx(step / 5, rel=0.15)
    assert (groups["assigned"] == truth).mean() > 0.97
    np.testing.assert_allclose(groups["weight"], np.array([30, 50, 80, 40]) / 200, atol=0.02)
    np.testing.assert_allclose(groups["probability"].sum("component"), 1)


def test_one_group_is_one_group():
    values = xr.DataArray(np.random.default_rng(1).normal(1, 0.1, 200), dims="column_id")
    assert mixture(values).sizes["component"] == 1


def test_the_criteria_are_those_of_the_literature():
    values, _ = scattered((INTENSITY[4] - INTENSITY[3]) / 3)
    groups = mixture(values, max_components=4)
    density = groups["weight"].values * stats.norm.pdf(
        values.values[:, None], groups["location"].values, groups["width"].item()
    )
    share = density / density.sum(axis=1, keepdims=True)
    bic = -2 * np.log(density.sum(axis=1)).sum() + 2 * groups.sizes["component"] * np.log(len(values))
    entropy = -(share * np.log(np.maximum(share, 1e-300))).sum()
    chosen = groups.sizes["component"]
    assert groups["bic"].sel(n_components=chosen).item() == pytest.approx(bic, abs=1e-3)
    assert groups["icl"].sel(n_components=chosen).item() == pytest.approx(bic + 2 * entropy, abs=0.1)


def test_columns_without_an_intensity_have_no_group():
    values, _ = scattered(0.01)
    values[7] = np.nan
    groups = mixture(values)
    assert groups["assigned"].values[7] == 0
    assert groups["probability"][7].isnull().all()
    assert (groups["assigned"].values[:7] == 1).all()


@pytest.mark.parametrize(
    ("values", "arguments", "message"),
    [
        (np.arange(4.0), {}, "too few columns"),
        (np.ones(40), {}, "too few columns"),
        (np.ones((5, 9)), {}, "one intensity for each column"),
        (np.arange(40.0), {"criterion": "aic"}, "criterion"),
    ],
)
def test_what_cannot_be_sorted_is_refused(values, arguments, message):
    dims = ("frame", "column_id")[-values.ndim :]
    with pytest.raises(SettingsError, match=message):
        mixture(xr.DataArray(values, dims=dims), **arguments)
