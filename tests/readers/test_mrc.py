"""MRC as IMOD, SerialEM, Direct Electron and FEI write it: values, counts, calibrations, and what lies beside it."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from files_classic import COUNTS, fei_records, mrc, mrc_4bit, nibbles

from tract_dask.errors import SourceError
from tract_dask.readers import open_source
from tract_dask.readers.source import SourceMetadata

WORDS = COUNTS.astype("<u2")


def notes(path: Path) -> str:
    return " | ".join(open_source(path).metadata.notes)


@pytest.mark.parametrize("suffix", [".mrc", ".mrcs", ".st", ".map", ".rec", ".ali"])
def test_every_suffix(suffix: str, tmp_path: Path) -> None:
    source = open_source(mrc(tmp_path / f"movie{suffix}", WORDS, 6, cella=(12, 10, 6)))
    np.testing.assert_array_equal(source.read(0, 6), WORDS)
    assert source.metadata == SourceMetadata(pixel_size_pm=50.0)


@pytest.mark.parametrize(
    ("fields", "dtype", "note"),
    [
        ({"dmin": 1, "dmax": 249}, "u1", ""),
        ({"dmin": -7, "dmax": 120}, "i1", ""),
        ({"dmin": -7, "dmax": 120, "imod": 0}, "u1", ""),
        ({"dmin": 1, "dmax": 249, "imod": 1}, "i1", ""),
        ({"dmin": 0, "dmax": -1}, "i1", "does not say whether bytes go from -128 to 127"),
        ({}, "i1", "does not say whether bytes go from -128 to 127"),
    ],
)
def test_the_sign_of_bytes(fields: dict[str, float], dtype: str, note: str, tmp_path: Path) -> None:
    source = open_source(mrc(tmp_path / "a.mrc", COUNTS, 0, **fields))
    assert source.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(source.read(0, 6), COUNTS.view(dtype))
    assert note in " ".join(source.metadata.notes)
    assert bool(source.metadata.notes) == bool(note)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    ("low", "high", "kind", "note"),
    [
        (0, 49800, "u2", "the numbers of mode 1 are read without a sign"),
        (-32568, 17032, "i2", "may have been stored with 32768 taken off"),
        (-5, 3000, "i2", ""),
        (0, 0, "i2", ""),
    ],
)
def test_the_sign_of_words(low: float, high: float, kind: str, note: str, order: str, tmp_path: Path) -> None:
    frames = (COUNTS.astype("u2") * 200).astype(f"{order}u2")
    source = open_source(mrc(tmp_path / "a.mrc", frames, 1, dmin=low, dmax=high, order=order))
    assert source.dtype == np.dtype(kind)
    np.testing.assert_array_equal(source.read(0, 6), frames.astype("u2").view(kind))
    assert note in notes(tmp_path / "a.mrc")
    assert bool(notes(tmp_path / "a.mrc")) == bool(note)


@pytest.mark.parametrize("n_x", [24, 23, 1])
def test_four_bits(n_x: int, tmp_path: Path) -> None:
    frames = np.random.default_rng(3).integers(0, 16, (5, 7, n_x))
    source = pickle.loads(pickle.dumps(open_source(mrc_4bit(tmp_path / "a.mrc", frames))))
    assert (source.shape, source.dtype) == ((5, 7, n_x), np.dtype("u1"))
    np.testing.assert_array_equal(source.read(1, 4), frames[1:4])
    one = np.empty((2, 7, n_x), "u1")
    source.read_into(3, one)
    np.testing.assert_array_equal(one, frames[3:])
    assert "not tested with a file from a camera" in notes(tmp_path / "a.mrc")


def test_four_bits_in_imods_bytes(tmp_path: Path) -> None:
    frames = np.random.default_rng(3).integers(0, 16, (2, 4, 6))
    source = open_source(mrc(tmp_path / "a.mrc", nibbles(frames), 0, imod=16))
    np.testing.assert_array_equal(source.read(0, 2), frames)


@pytest.mark.parametrize("mode", [3, 4, 16])
def test_complex_numbers_and_colours_are_refused_by_name(mode: int, tmp_path: Path) -> None:
    frames = np.zeros((2, 4, 4), {3: "i2, i2", 4: "c8", 16: "V3"}[mode])
    with pytest.raises(SourceError, match="RGB colours" if mode == 16 else "complex numbers"):
        open_source(mrc(tmp_path / "a.mrc", frames, mode))


@pytest.mark.parametrize(("counted", "order"), [(4, "<"), (0, "<"), (4, ">")])
def test_frames_that_the_header_does_not_count(counted: int, order: str, tmp_path: Path) -> None:
    source = open_source(mrc(tmp_path / "a.mrc", COUNTS.astype(f"{order}u2"), 6, nz=counted, order=order))
    np.testing.assert_array_equal(source.read(0, 6), COUNTS)
    assert source.metadata.notes == (f"a.mrc: its header counts {counted} frames, the file has 6; all are read",)


def test_bytes_that_are_no_whole_frames(tmp_path: Path) -> None:
    path = mrc(tmp_path / "a.mrc", WORDS, 6, nz=4)
    path.write_bytes(path.read_bytes()[:-1])
    assert open_source(path).shape[0] == 4
    assert "holds 1,919 bytes, as many as 2 frames, that its header does not account for" in notes(path)


def test_a_header_without_its_number_of_pixels_has_no_pixel_size(tmp_path: Path) -> None:
    path = mrc(tmp_path / "a.mrc", WORDS, 6, mx=0, my=0, mz=0, cella=(12, 10, 6))
    assert open_source(path).metadata.pixel_size_pm is None
    assert "mx, my, mz" in notes(path)


def test_axes_that_are_not_those_of_the_image(tmp_path: Path) -> None:
    path = mrc(tmp_path / "a.mrc", WORDS, 6, mapc=3, mapr=2, maps=1, mx=6, my=20, mz=24, cella=(9, 40, 48))
    assert open_source(path).metadata.pixel_size_pm == 200.0
    assert "are the axes z, y, x" in notes(path)


def test_feis_extended_header(tmp_path: Path) -> None:
    days = 43000 + np.array([0, 0.5, 1, 1.5, 4, 4.5]) / 86400
    tilts = np.linspace(-3, 2, 6)
    for kind in ("FEI1", "FEI2"):
        extended = fei_records(
            6, kind, Timestamp=days, Alpha_tilt=tilts, Pixel_size_X=2e-11, Pixel_size_Y=2e-11, Dose=3e20
        )
        path = mrc(tmp_path / f"{kind}.mrc", WORDS, 6, extended=extended, exttyp=kind.encode(), cella=(4.8, 4, 1))
        source = open_source(path)
        np.testing.assert_array_equal(source.read(0, 6), WORDS)
        known = source.metadata
        assert (known.pixel_size_pm, known.dose, known.frame_time_s) == (20.0, 3.0, 0.5)
        np.testing.assert_allclose(known.along_frames["time"].values, [0, 0.5, 1, 1.5, 4, 4.5], atol=1e-4)
        np.testing.assert_array_equal(known.along_frames["stage_tilt"].values, tilts)
        assert set(known.along_frames) == {"time", "stage_tilt"}
        assert "gap of 2.5 s after frame 3" in notes(path)


def test_two_pixel_sizes_that_contradict_each_other(tmp_path: Path) -> None:
    extended = fei_records(6, Pixel_size_X=2e-11, Pixel_size_Y=2e-11)
    path = mrc(tmp_path / "a.mrc", WORDS, 6, extended=extended, exttyp=b"FEI2", cella=(48, 40, 1))
    known = open_source(path).metadata
    assert (known.pixel_size_pm, known.along_frames, len(known.notes)) == (20.0, {}, 1)
    assert "gives a pixel size of 200 pm, the movie 20 pm, which is used" in notes(path)


def test_an_extended_header_that_claims_too_much(tmp_path: Path) -> None:
    for n_bytes, size in ((8, 2**31 - 1), (888, 0), (100, 5), (2000, -1)):
        extended = np.array([size], "<i4").tobytes().ljust(n_bytes, b"\xff")
        source = open_source(mrc(tmp_path / "a.mrc", WORDS, 6, extended=extended, exttyp=b"FEI2"))
        np.testing.assert_array_equal(source.read(0, 6), WORDS)


INFO = """\
Timestamp (seconds since Epoch)                                 = 1745955900
Autosave Counted Movie Pixel Format                             = uint8
Autosave Movie Frames Written                                   = {written}
Autosave Movie Sum Count                                        = 4
Frame Time (nanoseconds)                                        = 2500000
Frames Per Second                                               = 400
Scan - Enable                                                   = {scan}
Specimen Pixel Size X (nanometers)                              = {pixel}
Specimen Pixel Size Y (nanometers)                              = {pixel}
"""


@pytest.mark.parametrize("name", ["20250429_06699_0_movie", "20250429_06699", "20250429_06699_movie"])
def test_direct_electrons_file(name: str, tmp_path: Path) -> None:
    (tmp_path / "20250429_06699_info.txt").write_text(INFO.format(written=6, scan="Disable", pixel=0.02))
    asked: list[Path] = []
    source = open_source(mrc(tmp_path / f"{name}.mrc", COUNTS, 0), permit=asked.append)
    np.testing.assert_array_equal(source.read(0, 6), COUNTS)
    assert (source.metadata.pixel_size_pm, source.metadata.frame_time_s) == (20.0, 0.01)
    assert source.metadata.notes == ()
    assert {file.name for file in asked} == {f"{name}.mrc", "20250429_06699_info.txt"}


def test_direct_electrons_file_where_it_is_not_sound(tmp_path: Path) -> None:
    (tmp_path / "a_info.txt").write_text(INFO.format(written=9, scan="Enable", pixel=-1))
    path = mrc(tmp_path / "a_movie.mrc", WORDS, 6, cella=(-240, -200, 0))
    assert open_source(path).metadata.pixel_size_pm is None
    assert "9 frames were written; the movie has 6" in notes(path)
    assert "the frames belong to the points of a scan" in notes(path)
    final = mrc(tmp_path / "a_final.mrc", WORDS[:1], 6)
    assert open_source(final).metadata == SourceMetadata()


SECTIONS = """\
PixelSpacing = 1.25
ImageFile = a.st
[T = SerialEM: acquired on a day]
"""


def section(k: int, date: str, tilt: float) -> str:
    return f"[ZValue = {k}]\nTiltAngle = {tilt}\nExposureDose = 2.5\nPixelSpacing = 1.25\nDateTime = {date}\n\n"


def test_serialems_sections(tmp_path: Path) -> None:
    dates = [f"12-Oct-{year}  16:40:{34 + 2 * k}{'.25' * (k > 2)}" for k, year in enumerate((18, 18, 18, 2018, 18, 18))]
    text = SECTIONS + "".join(section(k, dates[k], k - 2.5) for k in (1, 0, 2, 5, 4, 3))
    (tmp_path / "a.st.mdoc").write_text(text)
    known = open_source(mrc(tmp_path / "a.st", WORDS, 6)).metadata
    assert (known.pixel_size_pm, known.dose, known.frame_time_s) == (125.0, 2.5, 2.0)
    np.testing.assert_allclose(known.along_frames["time"].values, [0, 2, 4, 6.25, 8.25, 10.25])
    np.testing.assert_allclose(known.along_frames["stage_tilt"].values, np.arange(6) - 2.5)
    assert known.notes == ()


def test_serialems_sections_of_another_stack(tmp_path: Path) -> None:
    (tmp_path / "a.mdoc").write_text(SECTIONS + section(0, "12-Oct-18  16:40:34", 0))
    known = open_source(mrc(tmp_path / "a.mrc", WORDS, 6)).metadata
    assert known.along_frames == {}
    assert known.notes == ("a.mdoc describes 1 sections, the movie has 6; what it says of each is not used",)


def test_references_that_were_not_applied(tmp_path: Path) -> None:
    lines = "[FrameSet = 0]\nGainReference = D:\\Refs\\CountRef_a.dm4\nDefectFile = defects_a.txt\n"
    (tmp_path / "a.mrc.mdoc").write_text(lines)
    (tmp_path / "defects_a.txt").write_text("x")
    known = open_source(mrc(tmp_path / "a.mrc", WORDS, 6)).metadata
    assert known.references == {"defects": tmp_path / "defects_a.txt"}
    assert "gain reference was not applied; it is CountRef_a.dm4, which is not there" in known.notes[0]
    assert "defects reference was not applied; it is defects_a.txt, which lies next to it" in known.notes[1]


def test_bytes_that_may_hold_two_pixels(tmp_path: Path) -> None:
    path = tmp_path / "a.mrc"
    mrc(path, COUNTS[:1], 0, nx=2880, ny=4092, nz=1, dmax=200)
    with path.open("r+b") as file:
        file.truncate(1024 + 2880 * 4092)
    assert "may be those of a K3 with two pixels of 4 bits in a byte" in notes(path)


@pytest.mark.parametrize(
    ("lines", "dose", "seconds", "note"),
    [
        ("ExposureTime = 1.2\nNumSubFrames = 6\nFrameDosesAndNumber = 0.5 6\n", 0.5, 0.2, ""),
        ("ExposureTime = 1.2\nNumSubFrames = 7\n", None, None, "counts 7 frames, the movie has 6"),
        ("FrameDosesAndNumber = 0.5 4\n", None, None, "doses of 4 frames, the movie has 6"),
        ("FrameDosesAndNumber = 0.5 2 1.25 4\n", 1.0, None, "the dose changes between frames"),
        ("ExposureTime = 1.2\nDividedBy2 = 1\n", None, 0.2, "divided the counts by 2"),
    ],
)
def test_serialems_set_of_frames(lines: str, dose: float, seconds: float, note: str, tmp_path: Path) -> None:
    (tmp_path / "a.mrc.mdoc").write_text(f"[T = x]\n[FrameSet = 0]\nPixelSpacing = 0.8\n{lines}")
    known = open_source(mrc(tmp_path / "a.mrc", WORDS, 6)).metadata
    assert (known.pixel_size_pm, known.dose, known.frame_time_s) == (80.0, dose, seconds)
    assert note in " ".join(known.notes)
    assert bool(known.notes) == bool(note)


def test_a_frame_time_of_another_place_does_not_hide_time_stamps(tmp_path: Path) -> None:
    seconds = np.array([0, 1, 2, 7, 8, 9]) * 2.01
    stamps = [45000 + second / 86400 for second in seconds]
    path = mrc(tmp_path / "acq_movie.mrc", COUNTS, 0, extended=fei_records(6, Timestamp=stamps), exttyp=b"FEI2")
    known = open_source(path).metadata
    assert known.frame_time_s == pytest.approx(2.01, abs=1e-6)
    np.testing.assert_allclose(known.along_frames["time"].values, seconds, atol=1e-5)


@pytest.mark.parametrize("name", ["acq_movie.mrc.mdoc", "acq_movie.mdoc", "acq_info.txt"])
def test_an_empty_file_beside_a_movie_says_nothing(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"")
    source = open_source(mrc(tmp_path / "acq_movie.mrc", COUNTS.astype("u2"), 6))
    assert source.metadata == SourceMetadata()


@pytest.mark.parametrize("exposure", ["inf", "nan", "-1", "1e300"])
def test_an_exposure_that_cannot_be_gives_no_frame_time(exposure: str, tmp_path: Path) -> None:
    text = f"[FrameSet = 0]\nExposureTime = {exposure}\nNumSubFrames = 6\n"
    (tmp_path / "a.mrc.mdoc").write_text(text)
    source = open_source(mrc(tmp_path / "a.mrc", COUNTS.astype("u2"), 6))
    assert source.metadata.frame_time_s is None
