"""Writers of small videos."""

from pathlib import Path

import av
import numpy as np


def write_video(
    path: Path, frames: np.ndarray, codec: str, pixels: str = "gray", rate: int = 20, **options: str
) -> Path:
    """Write grey frames (frames, y, x), or coloured ones (frames, y, x, 3), as a video; see PyAV for codecs."""
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=rate, options=options)
        stream.height, stream.width, stream.pix_fmt = *frames.shape[1:3], pixels
        kind = {"u1": "rgb24" if frames.ndim == 4 else "gray", "u2": "gray16le"}[frames.dtype.str[1:]]
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format=kind)))
        container.mux(stream.encode(None))
    return path
