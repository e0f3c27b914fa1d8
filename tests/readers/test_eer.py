"""EER: sums of readouts that are written here, bit by bit, from the public layout."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest
from files_classic import eer, opaque, short, tiff

from tract_dask.errors import SourceError
from tract_dask.readers import open_source

EVENTS = (np.random.default_rng(0).random((90, 40, 36)) < 0.03).astype("u1")
EVENTS[1], EVENTS[2] = 0, 1
EVENTS[3:20, -1, -1] = 1


@pytest.mark.parametrize("final", [False, True])
@pytest.mark.parametrize(("inside", "number"), [("", 40), ("::30", 30), ("::1", 1), ("::90", 90)])
def test_readouts_are_summed(inside: str, number: int, final: bool, tmp_path: Path) -> None:
    path = eer(tmp_path / "a.eer", EVENTS, final=final)
    source = pickle.loads(pickle.dumps(open_source(f"{path}{inside}")))
    n_frames = 90 // number
    truth = EVENTS[: n_frames * number].reshape(n_frames, number, 40, 36).sum(1)
    assert source.shape == truth.shape
    np.testing.assert_array_equal(source.read(0, n_frames), truth)
    np.testing.assert_array_equal(source.read(n_frames - 1, n_frames), truth[-1:])
    known = source.metadata
    assert (known.pixel_size_pm, known.frame_time_s) == (100.0, pytest.approx(0.004 * number))
    assert known.dose == pytest.approx(2.0 * number / 90)
    assert "not tested with a file from a camera" in known.notes[0]
    assert ("the last 10 of 90 readouts do not fill a frame of 40" in " ".join(known.notes)) == (number == 40)


def test_few_readouts_are_one_frame(tmp_path: Path) -> None:
    source = open_source(eer(tmp_path / "a.eer", EVENTS[:5]))
    np.testing.assert_array_equal(source.read(0, 1), EVENTS[:5].sum(0, keepdims=True))


def test_many_readouts_in_a_frame(tmp_path: Path) -> None:
    source = open_source(f"{eer(tmp_path / 'a.eer', np.ones((300, 3, 4), 'u1'))}::300")
    np.testing.assert_array_equal(source.read(0, 1), np.full((1, 3, 4), 300, "u2"))


@pytest.mark.parametrize("inside", ["0", "91", "x", "-1", "1.5"])
def test_what_is_no_number_of_readouts(inside: str, tmp_path: Path) -> None:
    path = eer(tmp_path / "a.eer", EVENTS)
    with pytest.raises(SourceError, match=r"not a number of readouts.*1 to 90"):
        open_source(f"{path}::{inside}")


@pytest.mark.parametrize("xml", ["", "<metadata>", "<metadata><item/></metadata>", '<!DOCTYPE x [<!ENTITY a "b">]>'])
def test_damaged_metadata_says_nothing(xml: str, tmp_path: Path) -> None:
    known = open_source(eer(tmp_path / "a.eer", EVENTS[:5], xml=xml or " ")).metadata
    assert (known.pixel_size_pm, known.frame_time_s, known.dose) == (None, None, None)


def test_a_number_of_readouts_that_is_not_there(tmp_path: Path) -> None:
    xml = '<metadata><item name="numberOfFrames">8</item><item name="exposureTime" unit="ms">40</item></metadata>'
    known = open_source(eer(tmp_path / "a.eer", EVENTS[:4], xml=xml)).metadata
    assert known.frame_time_s == 0.02
    assert "says that it has 8 readouts, it has 4" in " ".join(known.notes)


def test_what_is_not_eer_or_is_damaged(tmp_path: Path) -> None:
    path = tiff(tmp_path / "a.eer", [(bytes(12), (3, 4), [short(258, 8)])])
    with pytest.raises(SourceError, match="no readouts of a camera"):
        open_source(path)
    pages = [(b"\x01\x02\x03", (3, 4), [short(258, 1), short(259, 65001), opaque(65001, b"<metadata/>")])]
    with pytest.raises(SourceError, match=r"page 0 .* cannot be decoded"):
        open_source(tiff(path, pages)).read(0, 1)


def test_a_plain_name_reads_each_readout(tmp_path: Path) -> None:
    source = open_source(eer(tmp_path / "a.eer", EVENTS[:4]).rename(tmp_path / "a.tif"))
    assert source.shape == (4, 40, 36)
