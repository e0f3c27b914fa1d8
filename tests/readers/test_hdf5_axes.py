"""Axes of HDF5 data: taken by their names and units, whatever their order; spectra and the like are refused by name."""

from __future__ import annotations

import base64
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import zarr
from files_hdf5 import FRAMES, emd, hyperspy, nexus, velox

from tract_dask.errors import SourceError
from tract_dask.readers import FrameSource, open_source
from tract_dask.settings import MetadataSettings
from tract_dask.stages.convert.stage import convert
from tract_dask.store.movie import open_movie

LAST = FRAMES.transpose(1, 2, 0)
MIRROR = FRAMES.transpose(2, 1, 0)
Y, X, T = ("y", "nm", 0.02, False), ("x", "nm", 0.02, False), ("time", "ms", 40.0, True)


def same(source: FrameSource, frames: np.ndarray = FRAMES) -> None:
    for found in (source, pickle.loads(pickle.dumps(source))):
        np.testing.assert_array_equal(found.read(0, len(frames)), frames)
        np.testing.assert_array_equal(found.read(1, 4), frames[1:4])
        into = np.empty((2, *frames.shape[1:]), frames.dtype)
        found.read_into(2, into)
        np.testing.assert_array_equal(into, frames[2:4])


def fails(path: Path | str, *said: str) -> None:
    with pytest.raises(SourceError) as caught:
        open_source(path)
    assert all(part in str(caught.value) for part in said), str(caught.value)
    assert caught.value.remedy


def step(n: int, by: float = 0.02) -> np.ndarray:
    return np.arange(n) * by


def dimension_scales(path: Path) -> Path:
    with h5py.File(path, "w") as file:
        file["frames"] = LAST
        for k, (name, unit) in enumerate((("y", "nm"), ("x", "nm"), ("time", "s"))):
            file[name] = step(LAST.shape[k])
            file[name].attrs["units"] = unit
            file[name].make_scale()
            file["frames"].dims[k].attach_scale(file[name])
    return path


def labels(path: Path) -> Path:
    with h5py.File(path, "w") as file:
        file["frames"] = MIRROR
        for k, name in enumerate(("x", "y", "t")):
            file["frames"].dims[k].label = name
    return path


WRITERS: dict[str, tuple[Callable[[Path], object], float | None, float | None]] = {
    "nexus": (
        lambda path: nexus(path, LAST, ["y", "x", "frame_number"], x=(step(36), "nm"), y=(step(40), "nm")),
        20.0,
        None,
    ),
    "nexus mirrored": (lambda path: nexus(path, MIRROR, ["x", "y", "time"], time=(step(5, 4), "s")), None, 4.0),
    "nexus in order": (lambda path: nexus(path, FRAMES, [".", "y", "x"]), None, None),
    "emd by name": (
        lambda path: emd(path, MIRROR, [("R_x", "[n_m]", step(36)), ("R_y", "[n_m]", step(40)), ("", "", step(5))]),
        20.0,
        None,
    ),
    "emd by unit": (
        lambda path: emd(path, LAST, [("", "[n_m]", step(2)), ("", "[n_m]", step(2)), ("", "[s]", step(2))]),
        20.0,
        0.02,
    ),
    "emd from zero": (
        lambda path: emd(path, FRAMES, [("n", "", step(5)), ("y", "nm", step(2)), ("x", b"nm", step(2))], first=0),
        20.0,
        None,
    ),
    "emd with labels": (
        lambda path: emd(path, LAST, [("y", "A", step(40)), ("x", "A", step(36)), ("", "", list("abcde"))]),
        2.0,
        None,
    ),
    "emd of HyperSpy": (lambda path: emd(path, MIRROR, [("", "[]", step(2, 1))] * 3, record_by=""), None, None),
    "hyperspy": (lambda path: hyperspy(path, FRAMES, [T, Y, X]), 20.0, 0.04),
    "hyperspy without names": (
        lambda path: hyperspy(path, FRAMES, [("", "s", 0.5, True), ("", "nm", 0.02, False), ("", "nm", 0.02, False)]),
        20.0,
        0.5,
    ),
    "scales": (dimension_scales, 20.0, 0.02),
    "labels": (labels, None, None),
}


@pytest.mark.parametrize("name", WRITERS)
def test_the_movie_is_turned_as_its_axes_say(name: str, tmp_path: Path) -> None:
    write, pixel, seconds = WRITERS[name]
    write(tmp_path / "a.h5")
    source = open_source(tmp_path / "a.h5")
    same(source)
    assert (source.metadata.pixel_size_pm, source.metadata.frame_time_s) == (pixel, seconds)


@pytest.mark.parametrize("how", ["soft", "relative", "external"])
def test_axes_of_a_group_that_links_to_the_movie(how: str, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "part.h5", "w") as other, h5py.File(tmp_path / "a.nxs", "w") as file:
        holder = other if how == "external" else file
        holder["entry/instrument/detector/data"] = LAST
        file["entry/instrument/clock"] = step(5, 0.5)
        file["entry/instrument/clock"].attrs["units"] = "s"
        group = file.create_group("entry/data")
        group.attrs.update({"NX_class": "NXdata", "signal": "data", "axes": ["y", "x", "time"]})
        path = "/entry/instrument/detector/data"
        group["time"] = h5py.SoftLink("/entry/instrument/clock")
        if how == "external":
            group["data"] = h5py.ExternalLink("part.h5", path)
        else:
            group["data"] = h5py.SoftLink(path)
        if how == "relative":
            del group["data"]
            file.move(path, "/entry/data/own/data")
            group["data"] = h5py.SoftLink("own/data")
    for name in ("a.nxs", "a.nxs::/entry/data/data", "a.nxs::/entry/data"):
        source = open_source(f"{tmp_path}/{name}")
        same(source)
        assert source.metadata.frame_time_s == 0.5


def test_times_of_an_axis_with_lost_frames(tmp_path: Path) -> None:
    times = np.array([7.0, 7.5, 8.0, 9.5, 10.0])
    found = open_source(nexus(tmp_path / "a.nxs", FRAMES, ["t", "y", "x"], t=(times, "s"))).metadata
    assert found.frame_time_s == 0.5
    np.testing.assert_array_equal(found.along_frames["time"].values, times - 7)
    assert "gap of 1.5 s after frame 2" in found.notes[0]


@pytest.mark.parametrize(
    ("unit", "scale", "said"),
    [
        ("", 0.5, "along time is 0.5 without a unit"),
        ("frames", 0.5, "along time is 0.5 frames"),
        ("deg", 1.0, "along time is 1 deg"),
        ("frames", 1.0, ""),
        ("", 1.0, ""),
        ("ms/frame", 40.0, ""),
    ],
)
def test_a_step_between_frames_that_is_no_time_is_said(unit: str, scale: float, said: str, tmp_path: Path) -> None:
    known = open_source(hyperspy(tmp_path / "a.hspy", FRAMES, [("time", unit, scale, True), Y, X])).metadata
    assert known.frame_time_s == (0.04 if unit.startswith("ms") else None)
    assert [said in note for note in known.notes] == [True] * bool(said)


def test_axes_count_more_than_attributes_and_contradictions_are_said(tmp_path: Path) -> None:
    path = hyperspy(tmp_path / "a.hspy", FRAMES, [T, Y, X])
    with h5py.File(path, "a") as file:
        attributes = file["Experiments/x/data"].attrs
        attributes.update({"pixel_size_nm": 0.05, "frame_time_s": "0,04", "pixel_size_um": "wide"})
    known = open_source(path).metadata
    assert (known.pixel_size_pm, known.frame_time_s) == (20.0, 0.04)
    assert known.notes == (
        "a.hspy: its attribute pixel_size_um cannot be understood; it is not used",
        "a.hspy: the pixel size is 20 pm by its axes, 50 pm by its attributes",
    )


def test_a_frame_time_near_that_of_the_stamps_leaves_them(tmp_path: Path) -> None:
    times = np.array([0, 0.0401, 0.0802, 0.2005, 0.2406])
    path = nexus(tmp_path / "a.nxs", np.zeros((5, 64, 64), "u2"), ["t", "y", "x"], t=(times, "s"))
    with h5py.File(path, "a") as file:
        file["entry/data/counts"].attrs["frame_time_ms"] = 40.0
    movie = open_movie(convert(path, tmp_path / "movie.zarr"))
    np.testing.assert_allclose(movie.times(), times, atol=1e-12)
    assert movie.frame_time_s == 0.0401
    known = open_source(path, metadata=MetadataSettings(frame_time_s=0.02)).metadata
    assert known.frame_time_s == 0.02
    assert "their time stamps, usually 0.0401 s apart, are not used" in known.notes[-1]


@pytest.mark.parametrize("n_places", [2, 6])
def test_an_axis_with_two_places_or_with_edges_gives_its_step(n_places: int, tmp_path: Path) -> None:
    places = np.arange(n_places) * 0.5
    dims = [("t", "s", places), ("y", "nm", step(FRAMES.shape[1])), ("x", "nm", step(FRAMES.shape[2])[:2])]
    known = open_source(emd(tmp_path / "a.emd", FRAMES, dims)).metadata
    assert (known.pixel_size_pm, known.frame_time_s, dict(known.along_frames)) == (20.0, 0.5, {})


def test_velox_says_what_it_does_not_keep_of_very_many_frames(tmp_path: Path) -> None:
    known = open_source(velox(tmp_path / "a.emd", np.zeros((1001, 4, 4), "u2"))).metadata
    assert not known.along_frames
    assert "temperature of the first 1000 frames were read only; they are not kept" in known.notes[-1]


def test_times_of_a_fast_camera_keep_their_gap_in_the_store(tmp_path: Path) -> None:
    times = np.array([0, 1, 2, 5, 6]) / 7500
    frames = np.zeros((5, 64, 64), "u2")
    place = nexus(tmp_path / "a.nxs", frames, ["t", "y", "x"], t=(times, "s"))
    movie = open_movie(convert(place, tmp_path / "movie.zarr"))
    np.testing.assert_allclose(movie.times(), times, rtol=0, atol=1e-11)


REFUSED: dict[str, tuple[Callable[[Path], object], tuple[str, ...]]] = {
    "spectrum image": (
        lambda path: hyperspy(path, LAST, [(*Y[:3], True), (*X[:3], True), ("Energy loss", "eV", 1, False)]),
        ("spectrum image", "Energy loss (eV)"),
    ),
    "spectra without names": (
        lambda path: hyperspy(path, LAST, [("", "", 1, True), ("", "", 1, True), ("", "", 1, False)]),
        ("spectrum",),
    ),
    "line of spectra": (
        lambda path: hyperspy(path, LAST[0], [("x", "nm", 1, True), ("E", "keV", 1, False)]),
        ("spectrum", "E (keV)"),
    ),
    "four axes": (
        lambda path: emd(path, np.zeros((2, 3, 4, 5)), [(name, "", step(2)) for name in ("R_x", "R_y", "Q_x", "Q_y")]),
        ("4 axes", "R_x, R_y, Q_x, Q_y"),
    ),
    "channels": (lambda path: nexus(path, FRAMES, ["y", "x", "channel"]), ("colours", "channel")),
    "profile": (lambda path: nexus(path, FRAMES[0], ["time", "x"]), ("line profile",)),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_movie_is_refused_by_name(name: str, tmp_path: Path) -> None:
    write, said = REFUSED[name]
    write(tmp_path / "a.hspy")
    fails(tmp_path / "a.hspy", *said)


@pytest.mark.parametrize(
    ("dtype", "said"),
    [
        ([("r", "u1"), ("g", "u1"), ("b", "u1")], "RGB colours"),
        ([("realFloat", "<f4"), ("imagFloat", "<f4")], "complex numbers"),
        ("c8", "complex numbers"),
    ],
)
def test_pixels_that_are_no_numbers_are_refused_by_name(dtype: Any, said: str, tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["data"] = np.zeros((3, 4, 5), dtype)
    fails(f"{tmp_path / 'a.h5'}::/data", said)


def test_doubts_where_nothing_names_the_axes(tmp_path: Path) -> None:
    for name, shape, chunks, doubted in (
        ("turned", (20, 24, 6), None, True),
        ("deep", (4096, 16, 16), None, True),
        ("movie", (100, 64, 64), None, False),
        ("frames", (100, 20, 24), (1, 20, 24), False),
    ):
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            file.create_dataset("data", data=np.ones(shape, "u1"), chunks=chunks)
        notes = open_source(tmp_path / f"{name}.h5").metadata.notes
        assert any("nothing in the file names its axes" in note for note in notes) == doubted, name


def test_a_unit_that_is_no_length_is_named(tmp_path: Path) -> None:
    hyperspy(tmp_path / "a.hspy", FRAMES, [T, ("y", "1/nm", 0.1, False), ("x", "1/nm", 0.1, False)])
    found = open_source(tmp_path / "a.hspy").metadata
    assert found.pixel_size_pm is None
    assert "measured in 1/nm" in found.notes[0]
    hyperspy(tmp_path / "b.hspy", FRAMES, [T, ("y", "", 0.1, False), ("x", "", 0.1, False)])
    assert "the size 0.1 without a unit" in open_source(tmp_path / "b.hspy").metadata.notes[0]


@pytest.mark.parametrize("depth", [1, 3, 5])
def test_velox(depth: int, tmp_path: Path) -> None:
    source = open_source(velox(tmp_path / "a.emd", depth=depth))
    same(source)
    found = source.metadata
    assert (source.format, found.pixel_size_pm, found.frame_time_s, found.notes) == ("Velox EMD", 20.0, 0.25, ())
    np.testing.assert_allclose(found.along_frames["stage_tilt"].values, np.degrees(0.1 * np.arange(5)))
    np.testing.assert_array_equal(found.along_frames["temperature"].values, 20 + np.arange(5))
    assert found.along_frames["temperature"].units == "degC"


def test_velox_of_a_camera_and_of_diffraction(tmp_path: Path) -> None:
    camera = {"Detector-0": {"DetectorName": "HAADF", "DetectorType": "ImagingDetector", "ExposureTime": "0.4"}}
    found = open_source(velox(tmp_path / "a.emd", Detectors=camera, Scan={})).metadata
    assert found.frame_time_s == 0.4
    assert "exposure time" in found.notes[0]
    reciprocal = {"PixelSize": {"width": "1e8", "height": "1e8"}, "PixelUnitX": "1/m", "PixelUnitY": "1/m"}
    found = open_source(velox(tmp_path / "b.emd", BinaryResult=reciprocal)).metadata
    assert found.pixel_size_pm is None
    assert "measured in 1/m" in found.notes[0]


def test_several_signals_of_velox(tmp_path: Path) -> None:
    path = velox(tmp_path / "a.emd")
    velox(path, FRAMES[:1], name="b2", mode="a")
    same(open_source(path))
    velox(path, FRAMES + 1, name="c3", mode="a")
    fails(path, "/Data/Image/a1/Data (40, 36, 5) uint16 (HAADF)", "/Data/Image/c3/Data")
    same(open_source(f"{path}::/Data/Image/c3"), FRAMES + 1)


def test_damaged_texts_of_velox_are_a_note(tmp_path: Path) -> None:
    path = velox(tmp_path / "a.emd")
    with h5py.File(path, "a") as file:
        file["Data/Image/a1/Metadata"][:100] = 7
    source = open_source(path)
    same(source)
    assert "Velox's metadata are damaged" in source.metadata.notes[0]


def test_values_that_are_to_be_scaled_are_noted(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["data"] = FRAMES
        file["data"].attrs["scale_factor"] = 0.1
    assert "multiplied by 0.1 and 0 added" in open_source(tmp_path / "a.h5").metadata.notes[0]


def stated(path: Path, movie: np.ndarray[Any, Any], **attributes: Any) -> Path:
    """An array with attributes, in HDF5 or Zarr by the suffix."""
    if path.suffix == ".h5":
        with h5py.File(path, "w") as file:
            file["data"] = movie
            file["data"].attrs.update(attributes)
    else:
        array = zarr.create_array(str(path), shape=movie.shape, dtype=movie.dtype, chunks=(1, *movie.shape[1:]))
        array[:] = movie
        array.attrs.update(attributes)
    return path


@pytest.mark.parametrize("suffix", [".h5", ".zarr"])
@pytest.mark.parametrize("said", ["true", "True", "1"])
def test_numbers_that_lost_their_sign_are_read_without_one(said: str, suffix: str, tmp_path: Path) -> None:
    bright = FRAMES + 40_000
    path = stated(tmp_path / f"a{suffix}", bright.view("i2"), _Unsigned=said, _FillValue=-1)
    source = open_source(path)
    same(source, bright)
    assert source.dtype == "u2"
    assert "without a sign" in source.metadata.notes[0]
    assert (
        "pixels of 65535 are meant to carry no data (_FillValue); they are read as that number"
        in (source.metadata.notes[1])
    )
    small = np.full((2, 40, 36), 200, "u1")
    (note,) = open_source(stated(tmp_path / f"b{suffix}", small, _Unsigned="false")).metadata.notes
    assert "with a sign" in note
    assert open_source(tmp_path / f"b{suffix}").read(0, 2).min() == -56
    (note,) = open_source(stated(tmp_path / f"c{suffix}", small, _Unsigned="perhaps")).metadata.notes
    assert "_Unsigned cannot be understood" in note


@pytest.mark.parametrize("suffix", [".h5", ".zarr"])
@pytest.mark.parametrize("name", ["_FillValue", "missing_value"])
def test_pixels_that_carry_no_data_are_missing(name: str, suffix: str, tmp_path: Path) -> None:
    movie = FRAMES.astype("f4")
    movie[1, 3, 4:6] = 9.96921e36
    missing = np.where(movie > 1e30, np.nan, movie)
    fill = float(np.float32(9.96921e36))
    source = open_source(stated(tmp_path / f"a{suffix}", movie, **{name: fill}))
    np.testing.assert_array_equal(source.read(0, 5), missing)
    np.testing.assert_array_equal(source.read(1, 2), missing[1:2])
    assert "they are read as missing" in source.metadata.notes[0]
    assert open_source(stated(tmp_path / f"b{suffix}", movie, **{name: float("nan")})).metadata.notes == ()
    as_text = base64.b64encode(np.array(fill, "<f8").tobytes()).decode()  # as xarray writes it to Zarr stores
    np.testing.assert_array_equal(
        open_source(stated(tmp_path / f"c{suffix}", movie, **{name: as_text})).read(0, 5), missing
    )


@pytest.mark.parametrize(
    ("attributes", "words"),
    [
        ({"valid_min": 1.0}, "only numbers from 1 are meant"),
        ({"valid_range": [0, 900]}, "from 0 and up to 900"),
        ({"_FillValue": 0}, "pixels of 0 are meant to carry no data"),
        ({"_FillValue": 70_000}, ""),
        ({"_FillValue": "none"}, ""),
        ({"valid_range": [1, 2, 3]}, ""),
        ({"_Unsigned": "true"}, ""),
        ({"dt": 0.05}, "its attribute dt cannot be understood"),
        ({"scale": 0.02}, "its attribute scale cannot be understood"),
        ({"scale_factor": 1.0, "dtype": 3, "scaled": 2}, ""),
    ],
)
@pytest.mark.parametrize("suffix", [".h5", ".zarr"])
def test_what_attributes_say_of_numbers_is_noted(
    attributes: dict[str, Any], words: str, suffix: str, tmp_path: Path
) -> None:
    source = open_source(stated(tmp_path / f"a{suffix}", FRAMES, **attributes))
    same(source)
    assert words in " ".join(source.metadata.notes) if words else source.metadata.notes == ()


def test_pixels_of_a_virtual_data_set_that_come_from_nowhere(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "part.h5", "w") as file:
        file.create_dataset("data", FRAMES.shape, "u2", chunks=(1, 40, 36))[:2] = FRAMES[:2]
    layout = h5py.VirtualLayout((8, 40, 36), "u2")
    layout[:5] = h5py.VirtualSource("part.h5", "data", FRAMES.shape)
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_virtual_dataset("data", layout)
    notes = " ".join(open_source(tmp_path / "a.h5").metadata.notes)
    assert "4,320 of 11,520 pixels of the virtual data set come from no file" in notes
    assert "part.h5::/data: 3 of 5 chunks were never written" in notes


def test_a_heap_of_texts_without_an_end(tmp_path: Path) -> None:
    path = nexus(tmp_path / "a.nxs", FRAMES, ["frame", "y", "x"])
    whole = bytearray(path.read_bytes())
    at = whole.index(b"GCOL") + 16
    whole[at : at + 400] = bytes(400)
    path.write_bytes(whole)
    fails(path, "the texts in the file are damaged")


@pytest.mark.parametrize("damaged", [0, 3])
def test_a_damaged_text_of_velox_costs_only_what_it_said(damaged: int, tmp_path: Path) -> None:
    path = velox(tmp_path / "a.emd", FRAMES)
    with h5py.File(path, "a") as file:
        file["Data/Image/a1/Metadata"][:9, damaged] = ord("{")
    known = open_source(path).metadata
    assert (known.pixel_size_pm, known.frame_time_s) == (20.0, 0.25)
    temperatures = [np.nan if k == damaged else 20.0 + k for k in range(len(FRAMES))]
    np.testing.assert_array_equal(known.along_frames["temperature"].values, temperatures)
    assert any(f"metadata of 1 frames (first {damaged}) are damaged" in note for note in known.notes)


def test_units_in_the_names_of_axes_count(tmp_path: Path) -> None:
    path = hyperspy(
        tmp_path / "a.hspy",
        FRAMES,
        [("Time (ms)", "", 40.0, True), ("Y [nm]", "", 0.02, False), ("X [nm]", "", 0.02, False)],
    )
    known = open_source(path).metadata
    assert (known.pixel_size_pm, known.frame_time_s) == (20.0, 0.04)
