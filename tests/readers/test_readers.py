"""Every format gives back, bit for bit, what was written, with its calibration."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import h5py
import mrcfile
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st

from tract_dask.errors import SourceError
from tract_dask.readers import READERS, open_cached, open_source
from tract_dask.readers.blocks import BlockSource
from tract_dask.readers.movie_files import FileList
from tract_dask.readers.naming import in_order
from tract_dask.settings import MetadataSettings, SourceSettings

N_FRAMES, N_Y, N_X = 5, 24, 37
UNDECLARED = SourceSettings()
WIDENED = {"f2": np.dtype("f4"), "b1": np.dtype("u1")}


def movie(dtype: str = "u2", seed: int = 0) -> np.ndarray:
    """A movie whose every pixel, and every frame, is different from its neighbour."""
    values = np.random.default_rng(seed).integers(0, 120, (N_FRAMES, N_Y, N_X))
    return (values / 7 if np.dtype(dtype).kind == "f" else values).astype(dtype)


def assert_reads(path: Path | str, expected: np.ndarray, settings: SourceSettings = UNDECLARED) -> Any:
    """Check shape, type and pixels of all frames and of some, before and after pickling; return the source."""
    source = open_source(path, settings)
    assert source.shape == expected.shape
    assert source.dtype == WIDENED.get(expected.dtype.str[1:], expected.dtype.newbyteorder("="))
    assert source.dtype.isnative
    for reader in (source, pickle.loads(pickle.dumps(source))):
        for start, stop in ((0, source.shape[0]), (0, 1), (2, 4), (source.shape[0] - 1, source.shape[0]), (3, 3)):
            frames = reader.read(start, stop)
            assert frames.dtype == source.dtype
            assert frames.dtype.isnative
            assert frames.flags.c_contiguous
            assert frames.flags.writeable
            np.testing.assert_array_equal(frames, expected[start:stop])
    assert all(file.exists() for file in source.files)
    source.close()
    return source


IMAGEJ = {"axes": "TYX", "unit": "nm", "finterval": 0.1}
FLAVOURS: dict[str, tuple[str, dict[str, Any]]] = {
    "imagej u8": ("u1", {"imagej": True, "metadata": IMAGEJ}),
    "imagej u16": ("u2", {"imagej": True, "metadata": IMAGEJ}),
    "imagej f32": ("f4", {"imagej": True, "metadata": IMAGEJ}),
    "imagej z": ("f4", {"imagej": True, "metadata": {"axes": "ZYX"}}),
    "imagej channels": ("u2", {"imagej": True}),
    "bigtiff": ("u2", {"bigtiff": True}),
    "plain": ("u1", {"metadata": None}),
    "plain scattered": ("u2", {"metadata": None, "contiguous": False}),
    "strips": ("f4", {"metadata": None, "rowsperstrip": 7}),
    "zlib and predictor": ("f4", {"compression": "zlib", "predictor": True}),
    "zlib u16 and predictor": ("u2", {"compression": "zlib", "predictor": True, "byteorder": ">"}),
    "lzw tiled": ("u2", {"compression": "lzw", "tile": (16, 16)}),
    "tiled": ("u2", {"tile": (16, 16)}),
    "packbits": ("u1", {"compression": "packbits"}),
    "big-endian u16": ("u2", {"byteorder": ">"}),
    "big-endian f32": ("f4", {"byteorder": ">", "bigtiff": True}),
    "ome": ("u1", {"ome": True, "metadata": {"axes": "TYX"}}),
    "ome z": ("f4", {"ome": True, "metadata": {"axes": "ZYX"}}),
    "f16": ("f2", {}),
    "f64": ("f8", {}),
    "i8": ("i1", {}),
    "i16": ("i2", {}),
    "i32": ("i4", {}),
    "u32": ("u4", {}),
}


@pytest.mark.parametrize("flavour", FLAVOURS)
def test_tiff_flavours_equal_what_was_written(flavour: str, tmp_path: Path) -> None:
    dtype, options = FLAVOURS[flavour]
    frames = movie(dtype)
    with tifffile.TiffWriter(
        tmp_path / "movie.tif", **{k: options[k] for k in ("imagej", "ome", "bigtiff", "byteorder") if k in options}
    ) as writer:
        rest = {k: v for k, v in options.items() if k not in ("imagej", "ome", "bigtiff", "byteorder")}
        if "contiguous" in rest:
            for frame in frames:
                writer.write(frame, **rest)
        else:
            writer.write(frames, **rest)
    assert_reads(tmp_path / "movie.tif", frames)


def test_uncompressed_tiff_is_read_without_decoding(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "movie.tif", movie(), metadata=None, rowsperstrip=7)
    assert isinstance(open_source(tmp_path / "movie.tif"), BlockSource)


def test_one_image_is_one_frame(tmp_path: Path) -> None:
    frames = movie()[:1]
    tifffile.imwrite(tmp_path / "image.tiff", frames[0])
    np.save(tmp_path / "image.npy", frames[0])
    with h5py.File(tmp_path / "image.h5", "w") as file:
        file["image"] = frames[0]
    for name in ("image.tiff", "image.npy", "image.h5"):
        np.testing.assert_array_equal(open_source(tmp_path / name).read(0, 1), frames)


def test_imagej_file_over_4_gb_with_one_page(tmp_path: Path) -> None:
    """ImageJ writes one directory only, and the frames after it; the file is sparse, so the test is quick."""
    path, n_frames, shape = tmp_path / "large.tif", 1100, (1024, 2048)
    first, late = np.full(shape, 7, ">u2"), np.arange(shape[0] * shape[1], dtype=">u4").astype(">u2").reshape(shape)
    text = f"ImageJ=1.53t\nimages={n_frames}\nframes={n_frames}\nhyperstack=true\nunit=nm\nfinterval=0.04\n"
    tifffile.imwrite(path, first, byteorder=">", description=text, metadata=None, resolution=(100, 100))
    with path.open("r+b") as file:
        offset = path.stat().st_size - first.nbytes
        file.seek(offset + 1090 * first.nbytes)
        file.write(late.tobytes())
        file.truncate(offset + n_frames * first.nbytes)
    source = open_source(path)
    assert path.stat().st_size > 1 << 32
    assert source.shape == (n_frames, *shape)
    assert (source.metadata.pixel_size_pm, source.metadata.frame_time_s) == (10.0, 0.04)
    np.testing.assert_array_equal(source.read(1089, 1091), [np.zeros(shape), late])
    np.testing.assert_array_equal(source.read(0, 1)[0], first)


def test_tifffile_stack_with_one_page(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "movie.tif", movie(), metadata={}, contiguous=True, photometric="minisblack")
    with tifffile.TiffWriter(tmp_path / "one.tif") as writer:
        writer.write(movie(), metadata={}, truncate=True, photometric="minisblack")
    with tifffile.TiffFile(tmp_path / "one.tif") as tiff:
        assert len(tiff.pages) == 1
    assert_reads(tmp_path / "one.tif", movie())


def test_ome_pages_in_another_order(tmp_path: Path) -> None:
    frames, order = movie(), [3, 0, 4, 1, 2]
    blocks = "".join(f'<TiffData IFD="{page}" FirstT="{frame}"/>' for page, frame in enumerate(order))
    text = (
        '<?xml version="1.0" encoding="UTF-8"?><OME xmlns="http://www.openmicroscopy.org/Schemas/OME/2016-06">'
        f'<Image ID="Image:0"><Pixels DimensionOrder="XYZCT" Type="uint16" SizeX="{N_X}" SizeY="{N_Y}" SizeC="1"'
        f' SizeZ="1" SizeT="5" PhysicalSizeX="0.2" PhysicalSizeXUnit="Å">{blocks}</Pixels></Image></OME>'
    )
    tifffile.imwrite(tmp_path / "movie.tif", frames[order], description=text.encode(), metadata=None)
    assert assert_reads(tmp_path / "movie.tif", frames).metadata.pixel_size_pm == 20.0


def test_small_copies_of_pages_are_not_frames(tmp_path: Path) -> None:
    with tifffile.TiffWriter(tmp_path / "movie.tif") as writer:
        writer.write(movie()[0, ::4, ::4], subfiletype=1, metadata=None)
        for frame in movie():
            writer.write(frame, metadata=None, contiguous=False)
    assert_reads(tmp_path / "movie.tif", movie())


@pytest.mark.parametrize(
    ("options", "pixel_size_pm", "frame_time_s"),
    [
        ({"imagej": True, "metadata": IMAGEJ, "resolution": (250, 250)}, 4.0, 0.1),
        ({"imagej": True, "metadata": IMAGEJ | {"unit": "um"}, "resolution": (1e5, 1e5)}, 10.0, 0.1),
        ({"imagej": True, "metadata": {"axes": "ZYX", "unit": "\\u00B5m"}, "resolution": (2e4, 2e4)}, 50.0, None),
        ({"imagej": True, "metadata": {"axes": "TYX", "unit": "inch"}, "resolution": (72, 72)}, None, None),
        ({"imagej": True, "metadata": {"axes": "TYX", "unit": "pixel"}}, None, None),
        ({"imagej": True, "metadata": IMAGEJ | {"finterval": 40, "tunit": "ms"}, "resolution": (1, 1)}, 1000.0, 0.04),
        ({"resolution": (1e9, 1e9), "resolutionunit": "CENTIMETER"}, 10.0, None),
        ({"resolution": (300, 300), "resolutionunit": "INCH"}, None, None),
        ({"resolution": (28, 28), "resolutionunit": "CENTIMETER"}, None, None),
        (
            {
                "ome": True,
                "metadata": {
                    "axes": "TYX",
                    "PhysicalSizeX": 0.04,
                    "PhysicalSizeXUnit": "Å",
                    "TimeIncrement": 25.0,
                    "TimeIncrementUnit": "ms",
                },
            },
            4.0,
            0.025,
        ),
        ({"ome": True, "metadata": {"axes": "TYX", "PhysicalSizeX": 0.001}}, 1000.0, None),
    ],
)
def test_tiff_calibration(
    options: dict[str, Any], pixel_size_pm: float | None, frame_time_s: float | None, tmp_path: Path
) -> None:
    tifffile.imwrite(tmp_path / "movie.tif", movie(), **options)
    metadata = open_source(tmp_path / "movie.tif").metadata
    assert metadata.pixel_size_pm == (pixel_size_pm and pytest.approx(pixel_size_pm, rel=1e-6))
    assert metadata.frame_time_s == frame_time_s
    assert metadata.notes == ()


def test_digitalmicrograph_tiff_calibration(tmp_path: Path) -> None:
    tags = [(65003, "s", 0, "nm", True), (65005, "s", 0, "s", True), (65009, "d", 1, 0.02, True)]
    tags += [(65004, "s", 0, "nm", True), (65010, "d", 1, 0.03, True), (65011, "d", 1, 0.5, True)]
    tifffile.imwrite(tmp_path / "movie.tif", movie(), metadata=None, extratags=tags)
    metadata = open_source(tmp_path / "movie.tif").metadata
    assert (metadata.pixel_size_pm, metadata.frame_time_s) == (20.0, 0.5)
    assert "not square" in metadata.notes[0]


@pytest.mark.parametrize("dtype", ["i1", "i2", "u2", "f4", "f2"])
def test_mrc(dtype: str, tmp_path: Path) -> None:
    with mrcfile.new(tmp_path / "movie.mrc", data=movie(dtype)) as file:
        file.voxel_size = (0.04, 0.04, 1.0)
        file.set_extended_header(np.zeros(96, "u1"))
    assert assert_reads(tmp_path / "movie.mrc", movie(dtype)).metadata.pixel_size_pm == 4.0


def test_mrc_voxel_of_one_angstrom_or_none_is_unknown(tmp_path: Path) -> None:
    for voxel in (0.0, 1.0):
        with mrcfile.new(tmp_path / "movie.mrc", data=movie("f4"), overwrite=True) as file:
            file.voxel_size = voxel
        assert open_source(tmp_path / "movie.mrc").metadata.pixel_size_pm is None


@pytest.mark.parametrize("stamp", [0x11, 0x44])
def test_mrc_big_endian_whatever_its_stamp(stamp: int, tmp_path: Path) -> None:
    header = np.zeros(1, mrcfile.dtypes.HEADER_DTYPE.newbyteorder(">"))
    header["nx"], header["ny"], header["nz"], header["mode"] = N_X, N_Y, N_FRAMES, 1
    header["machst"] = stamp
    (tmp_path / "movie.mrc").write_bytes(header.tobytes() + movie(">i2").tobytes())
    assert_reads(tmp_path / "movie.mrc", movie("i2"))


def test_mrc_unsigned_bytes_of_imod(tmp_path: Path) -> None:
    with mrcfile.new(tmp_path / "movie.mrc", data=movie("i1")):
        pass
    data = bytearray((tmp_path / "movie.mrc").read_bytes())
    data[152:160] = np.array([1146047817, 0], "<i4").tobytes()
    (tmp_path / "movie.mrc").write_bytes(data)
    assert_reads(tmp_path / "movie.mrc", movie("u1"))


@pytest.mark.parametrize("dtype", ["u1", "i2", ">u2", "u4", "u8", "f2", ">f4", "f8"])
def test_npy(dtype: str, tmp_path: Path) -> None:
    np.save(tmp_path / "c.npy", movie(dtype))
    np.save(tmp_path / "f.npy", np.asfortranarray(movie(dtype)))
    for name in ("c.npy", "f.npy"):
        assert_reads(tmp_path / name, movie(dtype))


@pytest.mark.parametrize("options", [{}, {"chunks": (2, 8, 8), "compression": "gzip", "shuffle": True}])
@pytest.mark.parametrize("dtype", ["u1", ">u2", "f4"])
def test_hdf5_by_path_and_alone(options: dict[str, Any], dtype: str, tmp_path: Path) -> None:
    path = tmp_path / "movie.h5"
    with h5py.File(path, "w") as file:
        dataset = file.create_dataset("run/one/data", data=movie(dtype), **options)
        dataset.attrs["pixel_size_nm"], dataset.attrs["frame_time_ms"] = 0.004, 40
        file["run/one/time"] = np.arange(N_FRAMES)
    for name in (path, f"{path}::/run/one/data", f"{path}::run/one"):
        metadata = assert_reads(name, movie(dtype)).metadata
        assert (metadata.pixel_size_pm, metadata.frame_time_s) == (4.0, 0.04)


def test_hyperspy_axes(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "movie.hspy", "w") as file:
        signal = file.create_group("Experiments/movie")
        signal["data"] = movie()
        for number, (scale, unit) in enumerate([(0.5, "s"), (0.0092, "nm"), (0.0092, b"nm")]):
            signal.create_group(f"axis-{number}").attrs.update({"scale": scale, "units": unit})
    metadata = assert_reads(tmp_path / "movie.hspy", movie()).metadata
    assert (metadata.pixel_size_pm, metadata.frame_time_s) == (9.2, 0.5)


@pytest.mark.parametrize("name", ["movie.raw", "movie.u16"])
def test_raw(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"head" + movie(">u2").tobytes())
    for n_frames in (0, N_FRAMES):
        settings = SourceSettings(raw_shape=(n_frames, N_Y, N_X), raw_dtype=">u2", raw_offset=4)
        assert assert_reads(tmp_path / name, movie(), settings).metadata.notes == ()
    part = open_source(tmp_path / name, SourceSettings((2, N_Y, N_X), ">u2", 4))
    assert part.shape[0] == 2
    assert "not read" in part.metadata.notes[0]


def test_sequence_by_folder_and_glob_in_the_order_of_numbers(tmp_path: Path) -> None:
    frames = np.concatenate([movie(seed=seed) for seed in range(3)])
    folder = tmp_path / "run"
    folder.mkdir()
    for number, frame in enumerate(frames):
        tifffile.imwrite(folder / f"frame_{number}.tif", frame, resolution=(1e9, 1e9), resolutionunit="CENTIMETER")
    (folder / "notes.txt").write_text("not a frame")
    (folder / "._frame_1.tif").write_bytes(b"left by a Mac")
    for name in (folder, folder / "frame_*.tif", folder / "frame_?*.tif", folder / "[!x]*.tif"):
        source = assert_reads(name, frames)
        assert source.metadata.notes == ()
        assert source.metadata.pixel_size_pm == 10.0
        assert [file.name for file in source.files[8:11]] == ["frame_8.tif", "frame_9.tif", "frame_10.tif"]


def test_a_path_that_exists_is_no_pattern_and_a_folder_is_taken_as_it_is_written(tmp_path: Path) -> None:
    for folder, value in (("scan [2]", 2), ("scan 2", 22)):
        (tmp_path / folder).mkdir()
        for name in ("f_1.npy", "f[1].npy"):
            np.save(tmp_path / folder / name, np.full((1, N_Y, N_X), value if name == "f_1.npy" else 1, np.uint8))
    assert open_source(tmp_path / "scan [2]" / "f_*.npy").read(0, 1)[0, 0, 0] == 2
    assert open_source(tmp_path / "scan [2]").shape[0] == 2
    assert open_source(tmp_path / "scan [2]" / "f[1].npy").read(0, 1)[0, 0, 0] == 1
    (tmp_path / "scan [2]" / ".f_1.npy").write_bytes(b"hidden")
    assert open_source(tmp_path / "scan [2]" / "*.npy").shape[0] == 2
    for pattern in ("scan ?/f_*.npy", "sca*/f_1.npy", "**/f_1.npy", "*/f_*.npy"):
        with pytest.raises(SourceError, match="there is no such f"):
            open_source(tmp_path / pattern)


def test_a_list_of_files_is_opened_as_it_is_and_each_is_permitted_first(tmp_path: Path) -> None:
    for number in range(4):
        np.save(tmp_path / f"f_{number}.npy", np.full((1, N_Y, N_X), number, np.uint8))
    (tmp_path / "link.npy").symlink_to("f_3.npy")
    files = FileList(f"{tmp_path}/f_*.npy", tuple(tmp_path / name for name in ("f_1.npy", "f_2.npy", "link.npy")))
    asked: list[Path] = []
    source = open_source(files, permit=asked.append)
    assert source.path == f"{tmp_path}/f_*.npy"
    assert asked == [tmp_path / f"f_{number}.npy" for number in (1, 2, 3)]
    assert source.read(0, 3)[:, 0, 0].tolist() == [1, 2, 3]
    assert open_cached(files) is open_cached(files)

    def refuse(path: Path) -> None:
        if path.name == "f_3.npy":
            raise SourceError("refused", str(path))

    for name in (tmp_path / "link.npy", tmp_path / "f_*.npy", files):
        with pytest.raises(SourceError, match="refused"):
            open_source(name, permit=refuse)


def test_sequence_of_stacks_and_of_other_formats(tmp_path: Path) -> None:
    for number, length in enumerate((2, 1, 2)):
        first = (0, 2, 3)[number]
        np.save(tmp_path / f"part_{number}.npy", movie()[first : first + length])
        with h5py.File(tmp_path / f"part_{number}.h5", "w") as file:
            file["a"], file["b"] = movie()[first : first + length], np.zeros((3, 4, 5))
    assert_reads(tmp_path / "*.npy", movie())
    assert_reads(f"{tmp_path}/*.h5::/a", movie())


def test_a_gap_in_a_sequence_is_noted(tmp_path: Path) -> None:
    for number in (1, 2, 5, 6, 9):
        np.save(tmp_path / f"frame_{number:03}.npy", movie()[0])
    source = open_source(tmp_path)
    assert source.shape[0] == 5
    (note,) = source.metadata.notes
    assert "frame_005.npy follows frame_002.npy (and 1 more)" in note


def test_the_user_overrides_the_file(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "movie.tif", movie(), imagej=True, metadata=IMAGEJ, resolution=(250, 250))
    known = MetadataSettings(pixel_size_pm=7.8, dose=100.0, gain=2.5)
    metadata = open_source(tmp_path / "movie.tif", SourceSettings(), known).metadata
    assert (metadata.pixel_size_pm, metadata.frame_time_s, metadata.dose, metadata.gain) == (7.8, 0.1, 100.0, 2.5)


def test_the_path_stays_as_given(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    np.save(tmp_path / "movie.npy", movie())
    monkeypatch.chdir(tmp_path)
    assert open_source("movie.npy").path == "movie.npy"
    assert open_source(Path("movie.npy")).files == (Path("movie.npy"),)
    assert open_source("*.npy").shape == movie().shape


def test_cached_opening_notices_a_changed_file(tmp_path: Path) -> None:
    np.save(tmp_path / "movie.npy", movie())
    first = open_cached(tmp_path / "movie.npy")
    assert open_cached(tmp_path / "movie.npy") is first
    np.save(tmp_path / "movie.npy", movie()[:3])
    assert open_cached(tmp_path / "movie.npy").shape[0] == 3
    assert open_cached(f"{tmp_path}/*.npy").shape[0] == 3


def test_suffixes_in_capitals(tmp_path: Path) -> None:
    np.save(tmp_path / "movie.npy", movie())
    (tmp_path / "movie.npy").rename(tmp_path / "MOVIE.NPY")
    assert open_source(tmp_path / "MOVIE.NPY").shape == movie().shape


def test_every_suffix_is_documented() -> None:
    text = (Path(__file__).parents[2] / "docs" / "formats.md").read_text(encoding="utf-8")
    assert [suffix for suffix in READERS if f"`{suffix}`" not in text] == []


@settings(deadline=None)
@given(st.lists(st.integers(0, 40), unique=True, min_size=1, max_size=12), st.integers(0, 12), st.integers(0, 12))
def test_frames_anywhere_in_a_file(tmp_path_factory: pytest.TempPathFactory, places: list[int], a: int, b: int) -> None:
    """Runs of neighbours and lone frames, in any order, are read as slicing would."""
    data = np.arange(41 * 6, dtype=">u2").reshape(41, 2, 3)
    path = tmp_path_factory.getbasetemp() / "blocks.bin"
    path.write_bytes(data.tobytes())
    whole = open_source(path, SourceSettings((0, 2, 3), ">u2"))
    assert isinstance(whole, BlockSource)
    source = BlockSource(
        path=whole.path,
        files=whole.files,
        format="raw",
        shape=(len(places), 2, 3),
        dtype=whole.dtype,
        metadata=whole.metadata,
        offsets=whole.offsets[places],
        stored=whole.stored,
    )
    np.testing.assert_array_equal(source.read(a, b), data[places][a:b])


@given(st.lists(st.integers(0, 10**9), unique=True, max_size=20))
def test_natural_order_is_that_of_the_numbers(numbers: list[int]) -> None:
    names = [f"run2_{number}.tif" for number in numbers]
    assert in_order(names) == [f"run2_{number}.tif" for number in sorted(numbers)]
