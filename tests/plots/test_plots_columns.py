"""The figure of the columns: what it shows, and that it leaves pyplot alone."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr
from matplotlib.collections import PathCollection
from matplotlib.figure import Figure
from matplotlib.image import imread

from tract_dask.errors import StoreError
from tract_dask.plots.columns import plot_columns
from tract_dask.store.columns import column_dataset
from tract_dask.store.schema import Status


def scene(ny: int = 80, nx: int = 100, pixel_size_pm: float | None = 8.0) -> xr.Dataset:
    image = np.random.default_rng(0).poisson(3, (ny, nx)).astype(float)
    exposure = np.ones((ny, nx), "u4")
    image[:2], exposure[:2] = np.nan, 0
    return xr.Dataset(
        {"image": (("y", "x"), image), "exposure": (("y", "x"), exposure)}, attrs={"pixel_size_pm": pixel_size_pm}
    )


def some_columns(count: int = 6) -> xr.Dataset:
    places = np.stack([np.linspace(5, 99, count), np.linspace(3, 75, count)], axis=1)
    status = np.zeros(count, np.uint16)
    status[0], status[1] = Status.OUTSIDE_FRAME, Status.AT_BOUND | Status.BELOW_NOISE
    columns = column_dataset(places, ["Ce" if n % 2 else "O" for n in range(count)], status=status)
    return columns.assign_attrs(spacing_px=20.0)


def markers(figure: Figure) -> int:
    return sum(len(c.get_offsets()) for axes in figure.axes for c in axes.collections if isinstance(c, PathCollection))


def texts(figure: Figure) -> list[str]:
    return [text.get_text() for axes in figure.axes for text in axes.texts]


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for text in figure.legends[0].get_texts()]


def test_every_column_has_one_marker_and_an_id(tmp_path: Path) -> None:
    figure = plot_columns(scene(), some_columns(), tmp_path / "columns.png")
    assert markers(figure) == 6
    assert texts(figure)[:6] == ["1", "2", "3", "4", "5", "6"]
    assert legend(figure) == ["Ce (3)", "O (3)", "window leaves the image (1)", "fit in doubt (1)"]
    pixels = imread(tmp_path / "columns.png")
    assert pixels.shape[1] == 1125
    assert pixels[..., :3].std() > 0.05


def test_many_columns_have_no_ids() -> None:
    figure = plot_columns(scene(), some_columns(90))
    assert markers(figure) == 90
    assert len(texts(figure)) == 1


@pytest.mark.parametrize(("size", "label"), [(8.0, "0.1 nm"), (400.0, "5 nm"), (None, "10 px")])
def test_the_scale_bar_is_round_and_as_long_as_it_says(size: float | None, label: str) -> None:
    figure = plot_columns(scene(pixel_size_pm=size), some_columns())
    assert texts(figure)[-1] == label
    bar = figure.axes[1].patches[0]
    assert bar.get_width() == pytest.approx(float(label.split()[0]) * (1000 / size if size else 1))
    image, strip = figure.axes
    per_px = image.transData.transform((1, 0))[0] - image.transData.transform((0, 0))[0]
    assert strip.transData.transform((1, 0))[0] - strip.transData.transform((0, 0))[0] == pytest.approx(
        per_px, rel=0.01
    )


@pytest.mark.parametrize("shape", [(300, 40), (40, 300)])
def test_narrow_and_wide_images_can_be_drawn(shape: tuple[int, int], tmp_path: Path) -> None:
    columns = column_dataset([[10, 10], [20, 30]])
    assert markers(plot_columns(scene(*shape), columns, tmp_path / "c.pdf")) == 2
    assert (tmp_path / "c.pdf").stat().st_size > 1000


def test_pyplot_is_not_touched() -> None:
    before = "matplotlib.pyplot" in sys.modules
    plot_columns(scene(), some_columns())
    assert ("matplotlib.pyplot" in sys.modules) == before


def test_other_datasets_are_refused() -> None:
    with pytest.raises(StoreError, match="columns"):
        plot_columns(scene(), scene())
