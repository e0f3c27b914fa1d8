"""What to do with files that no reader opens: how each program exports something that is read."""

from __future__ import annotations

from collections.abc import Collection
from pathlib import Path

from ..errors import SourceError

_FIJI = "open it in Fiji by File > Import > Bio-Formats, then choose File > Save As > Tiff"
_PICTURE = "take the camera's own file, or save it as TIFF, 16 bit, without colours"
_UNPACK = "unpack it, then name the movie inside"

_RECIPES: dict[str, tuple[str, str]] = {
    ".cine": ("Phantom's", "save it as multipage TIFF, 16 bit, in Phantom Camera Control (PCC)"),
    ".tpx3": ("Timepix3 event", "sum the events into frames, and save those as TIFF, HDF5 or .npy"),
    ".blo": ("NanoMegas' block", "they hold a diffraction pattern for each point of a scan, and no movie"),
    ".gtg": (
        "Gatan's in-situ",
        "open the .dm4 or .dm5 file in the same folder; or export a .dm4 stack in DigitalMicrograph's In-Situ player",
    ),
    ".prz": ("HyperSpy's .prz", "save the array of its frames by numpy.save"),
    ".npz": ("NumPy's archive", "save the array of the frames alone by numpy.save"),
    ".mat": ("MATLAB's", "write the array to HDF5 by h5create and h5write, or to TIFF by imwrite"),
    ".rpl": ("Ripple's", "open the .raw file with its name, with --raw-shape and --raw-dtype as it says"),
    ".sif": ("Andor's", "export it as TIFF in Solis"),
    ".his": ("Hamamatsu's", "save it as multipage TIFF in HiPic or HCImage"),
    ".fits": ("FITS", _FIJI),
    ".fit": ("FITS", _FIJI),
    ".nd2": ("Nikon's", _FIJI),
    ".czi": ("Zeiss'", _FIJI),
    ".lif": ("Leica's", _FIJI),
    ".bcf": ("Bruker's spectrum", "they hold spectra, and no movie"),
    ".png": ("PNG", _PICTURE),
    ".jpg": ("JPEG", _PICTURE),
    ".jpeg": ("JPEG", _PICTURE),
    ".bmp": ("BMP", _PICTURE),
    ".gif": ("GIF", _PICTURE),
    ".zip": ("packed", _UNPACK),
    ".gz": ("packed", _UNPACK),
    ".bz2": ("packed", _UNPACK),
    ".xz": ("packed", _UNPACK),
    ".7z": ("packed", _UNPACK),
    ".tar": ("packed", _UNPACK),
}
"""By suffix: whose files they are, and how to get a movie that is read."""

_ANY = (
    "Export it as TIFF or MRC in the program that wrote it, or "
    + _FIJI
    + "; for a raw binary file declare --raw-shape and --raw-dtype"
)


def unknown_format(path: Path, suffixes: Collection[str]) -> SourceError:
    """Return the error for a file that no reader opens, with a recipe; ``suffixes`` are those that one opens."""
    suffix = path.suffix.lower()
    whose, recipe = _RECIPES.get(suffix, ("", ""))
    return SourceError(
        f"{whose} files are not read" if whose else "the format is unknown",
        str(path),
        f"a name that ends in one of {', '.join(suffixes)}",
        suffix or "a name without a suffix",
        recipe[:1].upper() + recipe[1:] if recipe else _ANY,
    )
