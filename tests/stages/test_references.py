"""Movies of a camera with a dark current, a gain pattern and faulty pixels, corrected by its references."""

from __future__ import annotations

import shutil
from dataclasses import replace

import h5py
import numpy as np
import pytest
import tifffile
import zarr
from conftest import Scene
from files_classic import mrc
from files_dm import write_dm

from tract_dask import convert, estimate_drift, fit_columns, open_movie, sum_image
from tract_dask.errors import DestinationError, MissingSourceError, SettingsError, SourceError
from tract_dask.progress import Warned
from tract_dask.readers import open_source
from tract_dask.run.inspect import describe
from tract_dask.run.verify import repair, verify
from tract_dask.settings import ConvertSettings, FitSettings, MetadataSettings, SourceSettings
from tract_dask.stages.convert.defects import finder_for
from tract_dask.stages.convert.origin import is_converted, movie_key, remembered_source
from tract_dask.stages.convert.reference_files import read_defects
from tract_dask.stages.convert.references import check_references, read_references, without_effect
from tract_dask.stages.convert.stage import remake
from tract_dask.store.schema import REJECTED

LAYOUT = {"tile_px": 32, "shard_mb": 1}
OFFSET, READ_NOISE, PATTERN = 100.0, 2.0, 0.1


class Camera:
    """What a camera of a fixed pattern records of a scene, and its references in files."""

    def __init__(self, folder, scene):
        rng = np.random.default_rng(3)
        self.scene, self.folder, self.rng = scene, folder, rng
        self.sensitivity = np.clip(rng.normal(1, PATTERN, scene.shape), 0.6, 1.4)
        self.dark = OFFSET + rng.uniform(0, 20, scene.shape)
        self.faulty = np.zeros(scene.shape, bool)
        self.faulty[rng.integers(0, scene.shape[0], 30), rng.integers(0, scene.shape[1], 30)] = True
        self.clean = np.stack([scene.frame(shift) for shift in scene.drift])
        counts = rng.poisson(self.clean)
        noise = rng.normal(0, READ_NOISE, self.clean.shape)
        self.even = np.where(self.faulty, np.nan, counts + noise).astype(np.float32)
        self.frames = np.rint(counts * self.sensitivity + self.dark + noise).astype(np.uint16)
        self.frames[:, self.faulty] = rng.integers(100, 200, (len(self.frames), self.faulty.sum()))
        self.save("movie", self.frames)
        darks = self.dark + rng.normal(0, READ_NOISE, (20, *scene.shape))
        self.save("dark", darks.astype(np.float32))
        self.save("gain", (3.7 / self.sensitivity).astype(np.float32))
        self.save("flat", (500 * self.sensitivity).astype(np.float32))
        self.save("defects", self.faulty)

    def save(self, name, values):
        np.save(self.folder / f"{name}.npy", values)

    def path(self, name):
        return str(self.folder / f"{name}.npy")

    @property
    def settings(self):
        named = {"dark": "dark", "gain_reference": "gain", "defects": "defects"}
        return ConvertSettings(**LAYOUT, **{name: self.path(file) for name, file in named.items()})


@pytest.fixture(scope="module")
def camera(tmp_path_factory):
    scene = Scene(n_frames=24, amplitude=120.0, background=40.0)
    return Camera(tmp_path_factory.mktemp("camera"), scene)


@pytest.fixture(scope="module")
def movie(camera):
    return open_movie(convert(camera.path("movie"), camera.folder / "movie.zarr", settings=camera.settings))


def expected(camera):
    dark = np.load(camera.path("dark")).mean(axis=0, dtype=np.float64)
    normal = camera.sensitivity / camera.sensitivity.mean()
    return np.where(camera.faulty, np.nan, (camera.frames - dark) / normal)


def test_frames_are_corrected_and_array_0_is_as_recorded(camera, movie):
    np.testing.assert_array_equal(zarr.open_array(movie.path / "0", mode="r")[:], camera.frames)
    assert movie.dtype == np.float32
    truth, found = expected(camera), movie.read(0, movie.n_frames)
    np.testing.assert_allclose(found, np.where(np.isnan(found), np.nan, truth), rtol=1e-5, atol=1e-3)
    assert np.isnan(found[:, camera.faulty]).all()
    assert np.isnan(found).mean() < 1.001 * camera.faulty.mean()
    assert movie.pixels.counts(movie.shape[1:])["given"] == camera.faulty.sum()


def test_tiles_and_lazy_frames_are_those_of_whole_frames(movie):
    whole = movie.read(0, movie.n_frames)
    np.testing.assert_array_equal(movie.frames[5:7, 2:40].compute(), whole[5:7, 2:40])
    np.testing.assert_array_equal(movie.read(3, 9, slice(90, 120), slice(-60, None)), whole[3:9, 90:120, -60:])
    for first, top, left, tile in movie.tiles(movie.shards[0]):
        n, height, width = tile.shape
        np.testing.assert_array_equal(tile, whole[first : first + n, top : top + height, left : left + width])
    tiles = movie.read_tiles(0, 3, np.array([[100, 100, 144, 144]]))
    np.testing.assert_array_equal(tiles.pixels[0], whole[:3, 96:128, 87:116])


def test_statistics_and_levels_are_of_corrected_pixels(camera, movie):
    truth = expected(camera)
    np.testing.assert_allclose(movie.statistics()["frame_mean"], np.nanmean(truth, axis=(1, 2)), rtol=1e-4)
    level = movie.read_binned(4, 0, 24)
    height, width = (side // 4 * 4 for side in movie.shape[1:])
    squares = movie.read(0, 24)[:, :height, :width].reshape(24, height // 4, 4, width // 4, 4)
    np.testing.assert_allclose(level, np.nanmean(squares, axis=(2, 4)), rtol=1e-4)


def test_columns_are_as_in_the_movie_of_an_even_camera(camera, movie, tmp_path):
    """Budget: sd of positions within 2 %, intensities within 1 %, of the same electrons seen by an even camera."""
    scene = camera.scene
    np.save(tmp_path / "even.npy", camera.even)
    even = open_movie(convert(tmp_path / "even.npy", tmp_path / "even.zarr", settings=ConvertSettings(**LAYOUT)))
    found = {}
    for name, one in (("even", even), ("corrected", movie)):
        tracks = fit_columns(
            one, scene.columns(), scene.drift_dataset(), FitSettings(refine_drift=False), summed=scene.summed()
        ).compute()
        ok = (tracks["status"].to_numpy() & REJECTED) == 0
        away = (tracks["fit"].sel(parameter=["x", "y"]).to_numpy() - scene.place)[ok]
        found[name] = away.std(), np.median(tracks["fit"].isel(parameter=0).to_numpy()[ok])
        assert ok.mean() > 0.99
    assert found["corrected"][0] == pytest.approx(found["even"][0], rel=0.02)
    assert found["corrected"][1] == pytest.approx(found["even"][1], rel=0.01)
    np.testing.assert_allclose(estimate_drift(movie)["drift"], estimate_drift(even)["drift"], atol=0.1)
    assert float(sum_image(movie, scene.drift_dataset())["image"].min()) > 20


def test_a_flat_field_divides(camera, movie, tmp_path):
    settings = ConvertSettings(
        **LAYOUT, dark=camera.path("dark"), gain_reference=camera.path("flat"), gain_reference_by="divide"
    )
    divided = open_movie(convert(camera.path("movie"), tmp_path / "movie.zarr", settings=settings))
    first, second = divided.read(0, 1), movie.read(0, 1)
    both = np.isfinite(first) & np.isfinite(second)
    np.testing.assert_allclose(first[both], second[both], rtol=1e-4, atol=1e-2)


def test_the_key_follows_what_references_hold(camera, tmp_path):
    source = open_source(camera.path("movie"))
    key = movie_key(source, camera.settings)
    assert key != movie_key(source, ConvertSettings(**LAYOUT))
    copy = tmp_path / "renamed.npy"
    copy.write_bytes((camera.folder / "dark.npy").read_bytes())
    same = ConvertSettings(**LAYOUT, dark=str(copy), gain_reference=camera.path("gain"), defects=camera.path("defects"))
    assert movie_key(source, same) == key
    np.save(copy, np.zeros(camera.scene.shape))
    assert movie_key(source, same) != key


def test_damaged_shards_and_masks_are_made_again_with_the_references(movie, tmp_path):
    copy = shutil.copytree(movie.path, tmp_path / "copy.zarr")
    names = ["0/c.1.0.0", "binned/4/c.0.0.0", "pixels/mask/c.0.0"]
    for name in names:
        (copy / name).unlink()
    repair(verify(copy))
    assert verify(copy).sound
    for name in names:
        assert (copy / name).read_bytes() == (movie.path / name).read_bytes()


def test_a_part_is_corrected_by_the_references_of_whole_frames(camera, movie, tmp_path):
    """Budget: sums of bins within 1 % of those of corrected pixels, though references are binned first."""
    declared = SourceSettings(roi="20:100,30:110", bin=2, frames="3:9")
    part = open_movie(
        convert(camera.path("movie"), tmp_path / "part.zarr", settings=camera.settings, source_settings=declared)
    )
    assert part.shape == (6, 40, 40)
    whole = movie.read(3, 9)[:, 20:100, 30:110].reshape(6, 40, 2, 40, 2).sum(axis=(2, 4))
    found = part.read(0, 6)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(whole))
    assert np.nanmean(found) == pytest.approx(np.nanmean(whole), rel=0.01)


@pytest.mark.parametrize(
    "text", ["x,y\n3,5\n7,9\n", "# bad\n3 5\n7 9\n", "y;note;x\n5;hot;3\n9;hot;7\n", '"x","y",\n"3","5",\n7.0,9\n']
)
def test_defects_as_a_list(camera, tmp_path, text):
    (tmp_path / "defects.txt").write_text(text)
    settings = ConvertSettings(**LAYOUT, find_defects=False, defects=str(tmp_path / "defects.txt"))
    pixels = open_movie(convert(camera.path("movie"), tmp_path / "movie.zarr", settings=settings)).pixels
    assert list(zip(*np.nonzero(pixels.mask), strict=True)) == [(5, 3), (9, 7)]


@pytest.mark.parametrize("photometric", ["minisblack", "miniswhite"])
def test_defects_as_a_mask_of_single_bits(camera, tmp_path, photometric):
    """Where white is stored as 0, numbers are turned over: the faulty pixels are the fewer ones."""
    mask = np.zeros(camera.faulty.shape, bool)
    mask[[5, 9], [3, 7]] = True
    tifffile.imwrite(tmp_path / "mask.tif", mask, photometric=photometric)
    np.testing.assert_array_equal(read_defects(str(tmp_path / "mask.tif"), open_source(camera.path("movie"))), mask)


@pytest.mark.parametrize(
    ("option", "values", "words"),
    [
        ("dark", np.zeros((20, 30)), "160 x 144 px, as a frame of the movie has; got 20 x 30 px. Use"),
        ("dark", np.zeros((144, 160)), "Turn it by 90 degrees"),
        ("gain_reference", np.zeros((160, 144)), "not above 0"),
        ("defects", np.ones((160, 144), bool), "the other way round"),
        ("dark", np.full((160, 144), np.nan), "dark image holds no numbers at most pixels.*leave it out"),
        ("dark", np.full((160, 144), np.inf), "dark image holds no numbers at most pixels"),
        ("gain_reference", np.full((160, 144), np.nan), "most pixels of the gain reference are not above 0"),
        ("defects", np.full((160, 144), np.nan), "leaves out most pixels"),
        ("dark", np.zeros((0, 160, 144)), "no frames"),
        ("gain_reference", np.zeros((1, 0, 0)), "wrong.npy"),
    ],
)
def test_what_does_not_fit_is_refused(camera, tmp_path, option, values, words):
    np.save(tmp_path / "wrong.npy", values)
    settings = ConvertSettings(**LAYOUT, **{option: str(tmp_path / "wrong.npy")})
    with pytest.raises(SourceError, match=words):
        convert(camera.path("movie"), tmp_path / "movie.zarr", settings=settings)


def test_references_that_leave_out_most_pixels_together_are_refused(camera):
    image = np.ones(camera.scene.shape, np.float32)
    camera.save("half dark", np.where(np.arange(160)[:, None] < 60, np.nan, image))
    camera.save("half faulty", np.arange(160)[:, None] + 0 * image > 100)
    settings = ConvertSettings(dark=camera.path("half dark"), defects=camera.path("half faulty"))
    with pytest.raises(SourceError, match=r"leave out most pixels.*26%"):
        read_references(open_source(camera.path("movie")), settings)
    (camera.folder / "all.csv").write_text("".join(f"{x},{y}\n" for x in range(144) for y in range(160)))
    with pytest.raises(SourceError, match=r"all\.csv: the references leave out most pixels"):
        read_references(open_source(camera.path("movie")), ConvertSettings(defects=str(camera.folder / "all.csv")))


def test_references_of_one_value_and_empty_lists_are_named(camera, tmp_path):
    (tmp_path / "none.csv").write_text("x,y\n")
    camera.save("level", np.full(camera.scene.shape, 100, np.uint16))
    camera.save("ones", np.ones(camera.scene.shape, np.float32))
    camera.save("zeros", np.zeros(camera.scene.shape, np.float32))
    told = []
    settings = ConvertSettings(
        **LAYOUT, dark=camera.path("level"), gain_reference=camera.path("ones"), defects=str(tmp_path / "none.csv")
    )
    convert(camera.path("movie"), tmp_path / "movie.zarr", settings=settings, on_event=told.append)
    words = [event.message for event in told if isinstance(event, Warned)]
    assert any("level.npy has one value 100 everywhere: it lowers all pixels alike" in said for said in words)
    assert any("ones.npy has one value everywhere: it changes no pixel" in said for said in words)
    assert any("none.csv names no pixel of the frames" in said for said in words)
    zeros = ConvertSettings(dark=camera.path("zeros"))
    (said,) = without_effect(zeros, read_references(open_source(camera.path("movie")), zeros))
    assert "zeros.npy has one value 0 everywhere: it changes no pixel" in said
    assert without_effect(camera.settings, read_references(open_source(camera.path("movie")), camera.settings)) == []


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x,y\n3,200\n", "line 2.*no such pixel"),
        ("1,2\nhot,5\n", "line 2.*not a pixel"),
        ("0,0,1,0\n0,1,0,0\n", "line 1.*4 words: 0 0 1 0.*save a mask as an image"),
        ("7,0;5,0\n", "line 1.*not a pixel"),
        ("x y\n1 7 5\n", "line 2.*3 words"),
    ],
)
def test_a_wrong_line_of_a_list_is_named(camera, tmp_path, text, words):
    (tmp_path / "defects.csv").write_text(text)
    settings = ConvertSettings(**LAYOUT, defects=str(tmp_path / "defects.csv"))
    with pytest.raises(SourceError, match=words):
        convert(camera.path("movie"), tmp_path / "movie.zarr", settings=settings)


@pytest.mark.parametrize(
    ("named", "words"),
    [
        ({"dark": "dark", "gain_reference": "flat"}, "is inverted.*Use --gain-reference-by divide"),
        ({"dark": "dark", "gain_reference": "other"}, "do not have the pattern"),
        (
            {"dark": "dark", "gain_reference": "moved"},
            r"otherwise.*1\.00 where.*move it by 2 px to the right and 1 px up\.$",
        ),
        ({"dark": "dark", "gain_reference": "flipped"}, "lies otherwise.*flip it top to bottom"),
        (
            {"dark": "dark", "gain_reference": "flipped flat"},
            "turn it by 180 degrees, and use --gain-reference-by divide",
        ),
        ({"dark": "mirrored"}, "dark image lies otherwise.*flip it left to right"),
        ({"dark": "dark", "gain_reference": "gain", "defects": "defects", "movie": "even"}, "brighter than the frames"),
        ({"gain_reference": "gain", "defects": "defects", "movie": "even"}, "do not have the pattern"),
        ({"gain_reference": "gain"}, "do not have the pattern.*give --dark"),
    ],
)
def test_references_that_make_frames_worse_are_refused(camera, tmp_path, named, words):
    other = np.random.default_rng(8).normal(1, PATTERN, camera.scene.shape)
    camera.save("other", other.astype(np.float32))
    camera.save("moved", np.roll(1 / camera.sensitivity, (1, -2), axis=(0, 1)).astype(np.float32))
    camera.save("flipped", (1 / camera.sensitivity[::-1]).astype(np.float32))
    camera.save("flipped flat", camera.sensitivity[::-1, ::-1].astype(np.float32))
    camera.save("mirrored", camera.dark[:, ::-1].astype(np.float32))
    camera.save("even", camera.even)
    source = camera.path(named.pop("movie", "movie"))
    settings = ConvertSettings(**LAYOUT, **{name: camera.path(file) for name, file in named.items()})
    with pytest.raises(SourceError, match=words):
        finder_for(open_source(source), tmp_path, settings)


def test_what_references_a_movie_was_made_with_is_told(camera, tmp_path):
    frames, dark, other = (tmp_path / name for name in ("movie.npy", "dark.npy", "other.npy"))
    np.save(frames, camera.frames[:3])
    np.save(dark, camera.dark)
    np.save(other, camera.dark - 1)
    made, settings = tmp_path / "movie.zarr", ConvertSettings(**LAYOUT, dark=str(dark), find_defects=False)
    told = []
    convert(frames, made, settings=settings, on_event=told.append)
    assert told[-1].summary.endswith("corrected by --dark")
    with pytest.raises(DestinationError, match=r"got convert\.dark has other contents than before\."):
        convert(frames, made, settings=replace(settings, dark=str(other)))
    with pytest.raises(DestinationError, match=r"got convert\.dark was given, and is not now\."):
        convert(frames, made, settings=replace(settings, dark=None))
    np.save(dark, camera.dark - 1)
    with pytest.raises(SourceError, match=f"^{dark}: this is not what"):
        remake(made, [0])
    frames.unlink()
    dark.unlink()
    gone = remembered_source(made, str(frames), MissingSourceError("gone"))
    assert is_converted(made, gone, settings, SourceSettings())
    with pytest.raises(MissingSourceError, match="nowhere"):
        is_converted(made, gone, replace(settings, dark="nowhere.npy"), SourceSettings())


def test_references_in_the_formats_of_cameras(camera, tmp_path):
    movie = open_source(camera.path("movie"))
    image = (2 / camera.sensitivity).astype(np.float32)
    write_dm(tmp_path / "a.dm4", image)
    tifffile.imwrite(tmp_path / "b.tif", image)
    tifffile.imwrite(tmp_path / "c.gain", image)
    mrc(tmp_path / "d.mrc", np.stack([image - 1, image + 1]), 2)
    with h5py.File(tmp_path / "e.h5", "w") as file:
        file["corrections/gain"] = image
    for name in ("a.dm4", "b.tif", "c.gain", "d.mrc", "e.h5::/corrections/gain"):
        settings = ConvertSettings(gain_reference=str(tmp_path / name))
        check_references(movie, settings, MetadataSettings())
        found = read_references(movie, settings).gain
        np.testing.assert_allclose(found, camera.sensitivity.mean() / camera.sensitivity, rtol=1e-5)
    image.tofile(tmp_path / "f.raw")
    with pytest.raises(SourceError, match=r"raw file cannot be a reference.*Save it as"):
        check_references(movie, ConvertSettings(dark=str(tmp_path / "f.raw")), MetadataSettings())


def test_an_offset_is_not_subtracted_twice(camera, tmp_path):
    with pytest.raises(SettingsError, match="holds the offset"):
        convert(
            camera.path("movie"),
            tmp_path / "movie.zarr",
            settings=camera.settings,
            metadata=MetadataSettings(offset=OFFSET),
        )


def test_references_beside_a_movie_are_named_with_their_options(camera, tmp_path):
    (tmp_path / "frames").mkdir()
    for number, frame in enumerate(camera.frames[:3]):
        np.save(tmp_path / "frames" / f"frame_{number}.npy", frame)
    dark = tmp_path / "frames" / "dark.npy"
    np.save(dark, camera.dark.astype(np.float32))
    assert "--dark dark.npy applies the detector's dark reference" in open_source(tmp_path / "frames").metadata.notes
    told = []
    settings = ConvertSettings(**LAYOUT, dark=str(dark))
    convert(tmp_path / "frames", tmp_path / "movie.zarr", settings=settings, on_event=told.append)
    assert not [event for event in told if "--dark" in getattr(event, "message", "")]
    assert describe(tmp_path / "movie.zarr")["dark"] == str(dark)
