"""Folders of files that are not simply the movie: the right frames in the right order, or a note."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import tifffile
from files_classic import COUNTS, fei_records, mrc
from hypothesis import given
from hypothesis import strategies as st

from tract_dask.readers import READERS, files_named_now, list_files, open_source
from tract_dask.readers.naming import gaps, in_order, notes_on, references
from tract_dask.readers.source import SourceMetadata


def folder(place: Path, names: Sequence[str]) -> Path:
    """Write one-frame files whose pixels are their number in the list."""
    for k, name in enumerate(names):
        np.save(place / name, np.full((3, 4), k, "u2"))
    return place


def order(place: Path | str) -> list[int]:
    source = open_source(place)
    return [int(frame[0, 0]) for frame in source.read(0, source.shape[0])]


def notes(place: Path | str) -> str:
    return " | ".join(open_source(place).metadata.notes)


@pytest.mark.parametrize(
    "names",
    [
        ["t_0.05s.npy", "t_0.1s.npy", "t_0.15s.npy", "t_0.2s.npy"],
        ["t_0,05s.npy", "t_0,1s.npy", "t_0,15s.npy", "t_0,2s.npy"],
        ["t_0.5.npy", "t_1.npy", "t_1.25.npy", "t_1.5.npy", "t_10.npy"],
        ["tilt_-10.npy", "tilt_-2.5.npy", "tilt_0.npy", "tilt_2.5.npy", "tilt_+10.npy"],
        ["tilt-10.npy", "tilt-5.npy", "tilt0.npy", "tilt5.npy"],
        ["-2.npy", "-1.npy", "0.npy", "1.npy"],
    ],
)
def test_decimals_and_signs_are_in_order_with_a_note(names: list[str], tmp_path: Path) -> None:
    folder(tmp_path, names)
    assert order(tmp_path) == order(f"{tmp_path}/*.npy") == list(range(len(names)))
    assert "taken with their signs and decimals" in notes(tmp_path)


@pytest.mark.parametrize(
    "names",
    [
        ["scan_1.8.npy", "scan_1.9.npy", "scan_1.10.npy", "scan_1.11.npy"],
        ["run-1.npy", "run-2.npy", "run-10.npy"],
        ["2024-01-05_9.npy", "2024-01-05_10.npy"],
        ["a.0001.npy", "a.0002.npy"],
        ["v1.2.3_1.npy", "v1.2.3_2.npy"],
        ["f_0.10.npy", "f_0.20.npy", "f_0.30.npy"],
    ],
)
def test_points_and_hyphens_that_only_separate(names: list[str], tmp_path: Path) -> None:
    folder(tmp_path, names)
    assert order(tmp_path) == list(range(len(names)))
    assert "decimals" not in notes(tmp_path)


@given(st.lists(st.decimals(-1000, 1000, places=3), unique=True, min_size=1, max_size=20))
def test_decimals_of_any_length_are_in_order(numbers: list[float]) -> None:
    names = [f"t_{float(number):g}.tif" for number in numbers if "e" not in f"{float(number):g}"]
    values = [float(name[2:-4]) for name in in_order(names)]
    assert values == sorted(values)


ODD = st.text(st.sampled_from("ab01.9,-+_ ()~٣²é") | st.characters(exclude_characters="/"), min_size=1, max_size=12)


@given(st.lists(ODD.map(lambda stem: f"{stem}.tif"), min_size=1, max_size=8, unique=True))
def test_any_names_have_an_order_and_notes(names: list[str]) -> None:
    found = in_order(names)
    assert sorted(found) == sorted(names)
    assert all(isinstance(note, str) for note in notes_on(found) + gaps(found))
    assert set(references(names)) < set(names)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("gain_ref.npy", "gain"),
        ("GainRef.npy", "gain"),
        ("reference.npy", "gain"),
        ("flatfield.npy", "gain"),
        ("dark.npy", "dark"),
        ("Background_01.npy", "dark"),
        ("defects.npy", "defects"),
    ],
)
def test_references_are_left_out_and_named(name: str, kind: str, tmp_path: Path) -> None:
    folder(tmp_path, [f"frame_{k:03d}.npy" for k in range(6)])
    np.save(tmp_path / name, np.zeros((3, 4), "f4"))
    for place in (tmp_path, f"{tmp_path}/*.npy"):
        assert order(place) == list(range(6))
        assert f"left out: {name} ({kind})" in notes(place)
        assert open_source(place).metadata.references == {kind: tmp_path / name}
        named, now = files_named_now(open_source(place)) or ((), ())
        assert named == now
    assert "not frames" not in notes(f"{tmp_path}/frame_*.npy")


def test_a_reference_of_another_format_does_not_matter(tmp_path: Path) -> None:
    folder(tmp_path, ["f_0.npy", "f_1.npy"])
    mrc(tmp_path / "gain.mrc", COUNTS, 0)
    assert order(tmp_path) == [0, 1]
    assert "gain.mrc (gain)" in notes(tmp_path)


@pytest.mark.parametrize(
    "names",
    [
        ["dark_0.npy", "dark_1.npy"],
        ["darkfield_0.npy", "f_1.npy"],
        ["dark field 0.npy", "f_1.npy"],
        ["again_0.npy"],
        [f"{word}_{k}.npy" for word in ("dark", "light") for k in range(4)],
    ],
)
def test_names_that_are_frames_all_the_same(names: list[str], tmp_path: Path) -> None:
    folder(tmp_path, names)
    assert len(order(tmp_path)) == len(names)
    assert references(names) == {}


def test_a_list_of_files_is_never_changed(tmp_path: Path) -> None:
    folder(tmp_path, ["f_0.npy", "f_1.npy", "gain.npy"])
    source = open_source([tmp_path / "gain.npy", tmp_path / "f_0.npy"])
    assert source.read(0, 2)[:, 0, 0].tolist() == [2, 0]
    assert source.metadata == SourceMetadata()


@pytest.mark.parametrize(
    ("names", "note"),
    [
        (["a_0.npy", "a_1.npy", "b_0.npy"], "of several kinds, read one after the other: a_0.npy (2 files), b_0.npy"),
        (["s1_f0.npy", "s1_f1.npy", "s2_f0.npy", "s2_f1.npy"], "of 2 series, read one after the other: the second"),
        (["f_0.npy", "f_1 (1).npy", "f_1.npy"], "f_1 (1).npy looks like a copy of f_1.npy; both"),
        (["f_0.npy", "f_1 - Copy.npy", "f_1.npy"], "f_1 - Copy.npy looks like a copy of f_1.npy"),
        (["Copy of f_1.npy", "f_0.npy", "f_1.npy"], "Copy of f_1.npy looks like a copy of f_1.npy"),
        (["f_0.npy", "f_1.npy", "f_5.npy"], "f_5.npy follows f_1.npy"),
        (["f_0.npy", "f_1.npy", "f_5.npy", "sum.npy"], "f_5.npy follows f_1.npy"),
        (["f_0.npy", "f_1.npy", "sum.npy"], "sum.npy (1 file)"),
        (["t_1e-2s.npy", "t_1e-3s.npy", "t_2e-3s.npy"], "numbers such as 1e-2, which are not taken for powers of ten"),
    ],
)
def test_what_a_person_would_not_take_for_one_movie(names: list[str], note: str, tmp_path: Path) -> None:
    assert note in notes(folder(tmp_path, names))


@pytest.mark.parametrize(
    "names",
    [
        [f"f_{k:04d}.npy" for k in range(20)],
        [f"12-{30 + k // 60:02d}-{k % 60:02d}.npy" for k in range(50, 70)],
        [f"t_{0.033 * k:.3f}.npy" for k in range(9)],
        ["only.npy"],
        ["f (1).npy", "f (2).npy"],
    ],
)
def test_good_names_have_no_notes(names: list[str]) -> None:
    assert notes_on(names) == ()


def test_gaps_of_decimals() -> None:
    assert gaps(["t_0.05.npy", "t_0.10.npy", "t_0.15.npy"]) == ()
    assert "t_0.25.npy follows t_0.10.npy" in gaps(["t_0.05.npy", "t_0.10.npy", "t_0.25.npy"])[0]


def test_a_calibration_that_changes_is_noted(tmp_path: Path) -> None:
    for k, pixels in enumerate((100, 100, 50, 50)):
        metadata = {"unit": "nm", "axes": "YX"}
        resolution = (pixels, pixels)
        tifffile.imwrite(tmp_path / f"f_{k}.tif", COUNTS[k], imagej=True, metadata=metadata, resolution=resolution)
    source = open_source(tmp_path)
    assert source.metadata.pixel_size_pm == 10.0
    assert "10 pm in f_0.tif, and 20 pm in f_2.tif (and 1 more files); the first is used" in notes(tmp_path)


def test_notes_of_all_files_are_kept_once(tmp_path: Path) -> None:
    for k in range(9):
        white = "miniswhite" if k < 5 else "minisblack"
        tifffile.imwrite(tmp_path / f"f_{k}.tif", COUNTS[0], photometric=white, metadata=None)
    with (tmp_path / "f_7.tif").open("ab") as file:
        file.write(bytes(1000))
    found = open_source(tmp_path).metadata.notes
    assert len(found) == 2
    assert "f_0.tif stores white as 0" in found[0]
    assert found[0].endswith("(and so of 4 more files)")
    assert "f_7.tif holds 1," in found[1]


def test_each_file_has_its_own_time_and_tilt(tmp_path: Path) -> None:
    dates = ["10.25", "10.75", "11.25", "13.25"]
    for k, second in enumerate(dates):
        mrc(tmp_path / f"f_{k}.mrc", COUNTS[k : k + 1].astype("<u2"), 6)
        text = f"[ZValue = 0]\nTiltAngle = {k}\nDateTime = 12-Oct-2024  16:40:{second}\n"
        (tmp_path / f"f_{k}.mrc.mdoc").write_text(text)
    known = open_source(tmp_path).metadata
    assert known.frame_time_s == 0.5
    np.testing.assert_allclose(known.along_frames["time"].values, [0, 0.5, 1, 3])
    np.testing.assert_array_equal(known.along_frames["stage_tilt"].values, range(4))
    assert "gap of 2 s after frame 2" in " ".join(known.notes)
    (tmp_path / "f_3.mrc.mdoc").unlink()
    known = open_source(tmp_path).metadata
    assert "time" not in known.along_frames
    np.testing.assert_array_equal(known.along_frames["stage_tilt"].values, [0, 1, 2, np.nan])


def test_files_of_several_frames_with_times(tmp_path: Path) -> None:
    for k in range(2):
        days = 43000 + (np.arange(3) + 10 * k) / 86400
        extended = fei_records(3, Timestamp=days)
        path = tmp_path / f"f_{k}.mrc"
        mrc(path, COUNTS[3 * k : 3 * k + 3].astype("<u2"), 6, extended=extended, exttyp=b"FEI2")
    known = open_source(tmp_path).metadata
    np.testing.assert_allclose(known.along_frames["time"].values, [0, 1, 2, 10, 11, 12], atol=1e-4)
    assert known.frame_time_s == pytest.approx(1, abs=1e-4)


def test_times_that_do_not_grow_are_not_used(tmp_path: Path) -> None:
    for k in range(3):
        mrc(tmp_path / f"f_{k}.mrc", COUNTS[k : k + 1].astype("<u2"), 6)
        (tmp_path / f"f_{k}.mrc.mdoc").write_text(f"[ZValue = 0]\nDateTime = 12-Oct-2024  16:40:{12 - k}\n")
    known = open_source(tmp_path).metadata
    assert known.along_frames == {}
    assert "do not grow" in " ".join(known.notes)


@pytest.mark.parametrize("fortran", [False, True])
def test_bytes_behind_an_array(fortran: bool, tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", np.asarray(COUNTS, order="F" if fortran else "C"))
    assert notes(tmp_path / "a.npy") == ""
    with (tmp_path / "a.npy").open("ab") as file:
        file.write(COUNTS[1:].tobytes())
    assert open_source(tmp_path / "a.npy").shape[0] == 6
    assert "holds 2,400 bytes, as many as 5 frames, that its header does not account for" in notes(tmp_path / "a.npy")


def test_a_folder_with_brackets_is_that_folder(tmp_path: Path) -> None:
    (tmp_path / "day[1]").mkdir()
    folder(tmp_path / "day[1]", ["f_0.npy", "f_1.npy"])
    assert order(f"{tmp_path}/day[1]/f_*.npy") == [0, 1]
    assert list_files("x", tmp_path / "day[1]", READERS) is not None


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["img_30-11-2026.tif", "img_01-12-2026.tif"], "dates such as 01-12-2026, with the year last"),
        (["img_2026-11-30.tif", "img_2026-12-01.tif"], ""),
        (["f_1.tif", "f_01.tif", "f_2.tif"], "f_01.tif and f_1.tif have the same numbers"),
    ],
)
def test_names_whose_order_is_in_doubt(names: list[str], words: str, tmp_path: Path) -> None:
    for name in names:
        tifffile.imwrite(tmp_path / name, np.zeros((4, 5), "u2"))
    notes = open_source(tmp_path).metadata.notes
    assert bool(notes) == bool(words)
    assert all(words in note for note in notes)


def test_files_that_hold_other_numbers_of_frames_and_links(tmp_path: Path) -> None:
    for k, length in enumerate((2, 2, 1)):
        np.save(tmp_path / f"f_{k}.npy", np.zeros((length, 4, 5)))
    assert open_source(tmp_path).metadata.notes == ()
    np.save(tmp_path / "f_3.npy", np.zeros((2, 4, 5)))
    (tmp_path / "f_4.npy").symlink_to("f_1.npy")
    assert open_source(tmp_path).metadata.notes == (
        "the files hold different numbers of frames: f_0.npy 2, f_2.npy 1",
        "f_4.npy is a link to f_1.npy; both are read as frames",
    )
