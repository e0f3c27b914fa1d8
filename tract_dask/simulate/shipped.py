"""A look-up table and an image of CeO2 that come with the package, for those without abTEM.

Both were made by ``tract-dask simulate``; the settings lie beside them in ``tract_dask/simulate/data``.
"""

from __future__ import annotations

from pathlib import Path

import xarray as xr

from .files import read_image, read_table

DATA = Path(__file__).parent / "data"


def ceo2_table() -> xr.Dataset:
    """Return the look-up table of cerium columns in CeO2 along [110], 1 to 12 atoms, for the paper's microscope.

    Returns
    -------
    Dataset
        As :func:`tract_dask.analysis.lookup.look_up_table`; the attributes say with which fit it was measured, and with
        which microscope. 4 pm a pixel, as in the paper.

    Examples
    --------
    >>> table = ceo2_table()
    >>> int(table["atoms"][table["intensity"].argmax()])  # columns of 6 atoms are brightest, as in Figure 5d
    6
    """
    return read_table(DATA / "ceo2_table.csv")


def ceo2_image() -> xr.Dataset:
    """Return the noise-free image of a CeO2 step along [110], vacuum = 1, with the truth about its columns.

    Returns
    -------
    Dataset
        As :func:`tract_dask.simulate.multislice_image`; 8 pm a pixel.
    """
    return read_image(DATA / "ceo2_image.tif")
