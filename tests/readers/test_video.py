"""Videos: the pixels of lossless ones are exact, compressed ones are named, coloured ones refused."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path

import av
import numpy as np
import pytest
from files_video import write_video

from tract_dask.errors import InputError, SourceError
from tract_dask.readers import open_source

FRAMES = np.random.default_rng(2).integers(0, 256, (25, 48, 64)).astype("u1")


@pytest.mark.parametrize(
    ("name", "codec", "pixels"),
    [
        ("a.avi", "rawvideo", "gray"),
        ("a.avi", "ffv1", "gray"),
        ("a.mov", "png", "gray"),
        ("a.avi", "ffv1", "gray16le"),
    ],
)
def test_lossless_videos_are_exact_at_any_frame(name: str, codec: str, pixels: str, tmp_path: Path) -> None:
    frames = FRAMES.astype("u2") * 257 if pixels == "gray16le" else FRAMES
    source = pickle.loads(pickle.dumps(open_source(write_video(tmp_path / name, frames, codec, pixels))))
    assert (source.shape, source.dtype, source.metadata.frame_time_s) == (frames.shape, frames.dtype, 0.05)
    assert source.metadata.notes == ()
    for start, stop in ((0, 25), (7, 9), (24, 25), (0, 1)):
        np.testing.assert_array_equal(source.read(start, stop), frames[start:stop])


def smooth() -> np.ndarray:
    y, x = np.mgrid[:48, :64]
    shift = np.arange(25)[:, None, None]
    return np.rint(120 + 80 * np.sin((x + shift) / 9) * np.cos(y / 11)).astype("u1")


@pytest.mark.parametrize(("name", "codec"), [("a.mp4", "libx264"), ("a.avi", "mjpeg"), ("a.mov", "mpeg4")])
def test_compressed_videos_are_near_and_named(name: str, codec: str, tmp_path: Path) -> None:
    pixels = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    source = open_source(write_video(tmp_path / name, smooth(), codec, pixels))
    assert (source.shape, source.metadata.frame_time_s) == (FRAMES.shape, 0.05)
    assert "changes the pixels" in source.metadata.notes[0]
    for start in (13, 3, 24):
        distance = np.abs(source.read(start, start + 1)[0].astype(int) - smooth()).mean(axis=(1, 2))
        assert distance.argmin() == start
        assert distance[start] < 6


def test_colours_are_refused(tmp_path: Path) -> None:
    coloured = np.stack([FRAMES, FRAMES // 2, FRAMES], axis=3)
    with pytest.raises(SourceError, match="the pixels are RGB colours"):
        open_source(write_video(tmp_path / "a.avi", coloured, "rawvideo", "bgr24"))


def test_without_the_package_the_error_says_how_to_get_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_video(tmp_path / "a.avi", FRAMES, "rawvideo")
    monkeypatch.setitem(sys.modules, "av", None)
    with pytest.raises(InputError, match=r"pip install .tract_dask\[video\]"):
        open_source(path)


def damaged(path: Path, number: int) -> None:
    """Flip one bit in the middle of a frame."""
    with av.open(str(path)) as container:
        places = [(packet.pos, packet.size) for packet in container.demux(video=0) if packet.size]
    content = bytearray(path.read_bytes())
    content[places[number][0] + places[number][1] // 2] ^= 4
    path.write_bytes(content)


@pytest.mark.parametrize(("name", "codec"), [("a.avi", "ffv1"), ("a.mov", "png")])
def test_a_damaged_frame_is_refused_each_time_and_hides_no_other(name: str, codec: str, tmp_path: Path) -> None:
    for number in (0, 7):
        path = write_video(tmp_path / name, FRAMES, codec, g="1")
        damaged(path, number)
        source = open_source(path)
        for _ in range(2):
            with pytest.raises(SourceError, match=name):
                source.read(number, number + 1)
        with pytest.raises(SourceError, match=name):
            source.read(0, 25)
        for start, stop in ((0, number), (number + 1, 25)):
            if stop > start:
                np.testing.assert_array_equal(source.read(start, stop), FRAMES[start:stop])


def test_frames_that_are_computed_from_a_damaged_one_are_refused(tmp_path: Path) -> None:
    path = write_video(tmp_path / "a.avi", FRAMES, "ffv1", g="10")
    damaged(path, 12)
    source = open_source(path)
    with pytest.raises(SourceError, match=r"frame 1[2-5] of the video, or one that it is computed from, is damaged"):
        source.read(15, 16)
    for number in (11, 20):
        np.testing.assert_array_equal(source.read(number, number + 1), FRAMES[number : number + 1])
