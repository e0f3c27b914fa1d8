"""The formats that are read: those of this package, and those of others by the entry point ``tract_dask.readers``."""

from __future__ import annotations

from . import video
from .dm import in_situ as gatan
from .hdf5 import open_hdf5
from .hdf5.dectris import is_part
from .merlin import headers_of_mibs, open_merlin
from .mrc import open_mrc
from .npy import open_npy
from .others import Readers
from .reader import Reader, one_by_one
from .seq import belongs_to_seq, open_seq
from .tia import is_emi, open_tia
from .tiff import open_tiff
from .tiff.eer import open_eer
from .tvips import is_later_part, open_tvips
from .zarr import open_zarr
from .zarr.place import is_zarr

BUILT_IN = (
    Reader("TIFF", (".tif", ".tiff", ".stk"), open_tiff),
    Reader("EER", (".eer",), open_eer, inside="how many readouts are summed into a frame"),
    Reader("MRC", (".mrc", ".mrcs", ".st", ".map", ".rec", ".ali"), open_mrc, parts=one_by_one(belongs_to_seq)),
    Reader("NumPy", (".npy",), open_npy),
    Reader(
        "HDF5",
        (".h5", ".hdf5", ".hspy", ".emd", ".nxs"),
        open_hdf5,
        inside="the path of a data set",
        parts=one_by_one(is_part),
    ),
    Reader("Zarr", (".zarr", ".zspy"), open_zarr, inside="the path of an array", is_movie=is_zarr),
    Reader("video", video.SUFFIXES, video.open_video),
    Reader("TIA", (".ser", ".emi"), open_tia, parts=one_by_one(is_emi)),
    Reader("TVIPS", (".tvips",), open_tvips, parts=one_by_one(is_later_part)),
    Reader("StreamPix", (".seq",), open_seq),
    Reader("Merlin", (".mib", ".hdr"), open_merlin, parts=headers_of_mibs),
    Reader(
        "DigitalMicrograph", gatan.SUFFIXES, gatan.open_gatan, inside="the number of an image", is_movie=gatan.is_movie
    ),
    Reader("raw", (".raw", ".bin", ".dat"), gatan.open_raw_or_movie, parts=one_by_one(gatan.is_part)),
)
"""The formats that this package reads. A new format is a line here."""


READERS = Readers(BUILT_IN)
"""The reader of each suffix."""
