"""What answers to the mouse: the summed image with its columns, their series in time, and curves over the frames.

All are Bokeh figures that need nothing but the script in the page. Columns that are chosen in one figure are chosen in
all of them, since they share a source.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import xarray as xr
from bokeh.models import (
    ColorBar,
    ColumnDataSource,
    CustomJS,
    HoverTool,
    LinearColorMapper,
    Range1d,
    Span,
    TapTool,
)
from bokeh.plotting import figure
from numpy.typing import NDArray

from .pictures import grey_levels
from .survey import QUANTITIES, Survey, frame_curve

LINES = ("#3b82c4", "#d9622b")
"""Of lines on light and dark pages alike."""
FINE = "#8a8f98"
_IMAGE_PX = 900
_MISSING = -32768
_STEPS = 65534
_TOOLS = "pan,wheel_zoom,box_zoom,reset,save"
_MAP = "Viridis256"


@dataclass(frozen=True)
class Shade:
    """A number by which the columns on the image can be coloured."""

    name: str
    label: str
    factor: float = 1.0


def shades(run: Survey) -> list[Shade]:
    """Return the numbers by which columns can be coloured, as far as they are known."""
    every = [
        Shade("spread", f"spread ({run.unit})"),
        Shade("excess", "spread / stated error"),
        Shade("share", "accepted (%)", 100.0),
        Shade("r_squared", "R²"),
        Shade("intensity", "intensity (counts)"),
        Shade("residual", "residual (% of amplitude)", 100.0),
    ]
    return [shade for shade in every if np.isfinite(run.columns[shade.name]).any()]


def column_source(run: Survey) -> ColumnDataSource:
    """Return the columns as the source that all figures of columns share."""
    columns = run.columns
    data: dict[str, Any] = {
        "id": columns["column_id"].to_numpy(),
        "x": columns["x_ref"].to_numpy(),
        "y": columns["y_ref"].to_numpy(),
        "kind": [str(kind) or "-" for kind in columns["kind"].to_numpy()],
        "fits": columns["fits"].to_numpy(),
        "expected": columns["expected"].to_numpy(),
    }
    data |= {shade.name: columns[shade.name].to_numpy().astype(float) * shade.factor for shade in shades(run)}
    first = shades(run)[0].name if shades(run) else "expected"
    return ColumnDataSource(data | {"shade": data[first]}, name="columns")


def image_figure(run: Survey, source: ColumnDataSource) -> figure:
    """Return the summed image with its columns: hover tells their numbers, a click chooses one."""
    exposed = (run.summed["exposure"] > 0).to_numpy()
    levels = grey_levels(run.summed["image"].to_numpy(), exposed, _IMAGE_PX)
    ny, nx = exposed.shape
    step = -(-max(ny, nx) // _IMAGE_PX)
    plot = figure(
        x_range=Range1d(-0.5, nx - 0.5, bounds=(-0.25 * nx, 1.25 * nx)),
        y_range=Range1d(ny - 0.5, -0.5, bounds=(-0.25 * ny, 1.25 * ny)),
        match_aspect=True,
        tools=_TOOLS,
        active_scroll="wheel_zoom",
        x_axis_label="x (px)",
        y_axis_label="y (px)",
        sizing_mode="stretch_width",
        aspect_ratio=max(0.5, min(2.0, nx / ny)),
        name="image",
    )
    grey = LinearColorMapper([f"#{level:02x}{level:02x}{level:02x}" for level in range(256)], low=0, high=255)
    height, width = levels.shape
    plot.image([levels], -0.5, -0.5, width * step, height * step, color_mapper=grey, level="image")  # y runs down
    plot.grid.visible = False
    shade = LinearColorMapper(_MAP, low=0.0, high=1.0, nan_color="rgba(0,0,0,0)", name="shade")
    known = {item.name: item for item in shades(run)}
    discs = plot.scatter(
        "x",
        "y",
        source=source,
        size=11,
        fill_color={"field": "shade", "transform": shade},
        line_color="white",
        line_width=1.2,
        nonselection_fill_alpha=0.85,
        nonselection_line_alpha=0.85,
        selection_line_color="#ff4d4d",
        selection_line_width=3.5,
        hover_line_color="#ffb000",
        hover_line_width=3,
    )
    tips = [("column", "@id @kind"), ("x, y", "@x{0.00}, @y{0.00} px")]
    tips += [(item.label, f"@{name}{{0.00}}") for name, item in known.items()]
    plot.add_tools(HoverTool(renderers=[discs], tooltips=tips), TapTool(renderers=[discs]))
    plot.add_layout(ColorBar(color_mapper=shade, width=10, padding=4, name="shade_bar"), "right")
    return plot


def series_figures(run: Survey, source: ColumnDataSource) -> list[figure]:
    """Return x, y and intensity of the chosen column in time, with their errors; choosing one fills them."""
    packed, scales = _packed(run.series)
    line = ColumnDataSource({name: [] for name in ("t", *QUANTITIES)}, name="line")
    bands = {
        f"{quantity}_{kind}": ColumnDataSource({"t": [], "v": []})
        for quantity in QUANTITIES
        for kind in ("range", "error")
    }
    labels = {"x": f"x ({run.unit})", "y": f"y ({run.unit})", "intensity": "intensity (counts)"}
    time = run.series["time"].to_numpy()
    plots: list[figure] = []
    for quantity, label in labels.items():
        shared: dict[str, Any] = {"x_range": plots[0].x_range} if plots else {}
        plot = figure(
            tools=_TOOLS,
            active_scroll="wheel_zoom",
            y_axis_label=label,
            sizing_mode="stretch_width",
            height=210,
            name=quantity,
            **shared,
        )
        colour = LINES[0]
        plot.patch("t", "v", source=bands[f"{quantity}_range"], fill_color=colour, fill_alpha=0.18, line_alpha=0)
        plot.patch("t", "v", source=bands[f"{quantity}_error"], fill_color=colour, fill_alpha=0.35, line_alpha=0)
        plot.line("t", quantity, source=line, color=colour, line_width=1.3)
        points = plot.scatter("t", quantity, source=line, color=colour, size=4 if len(time) <= 400 else 2)
        plot.add_tools(
            HoverTool(
                renderers=[points], tooltips=[("time", "@t{0.000}"), (label, f"@{quantity}{{0.00}}")], mode="mouse"
            )
        )
        if quantity != "intensity":
            plot.add_layout(Span(location=0, dimension="width", line_color=FINE, line_dash="dashed", line_width=1))
        plots.append(plot)
    plots[-1].xaxis.axis_label = f"time ({run.time_unit})"
    plots[0].x_range.start, plots[0].x_range.end = _limits(time)
    arguments = {
        "columns": source,
        "packed": packed,
        "scales": scales,
        "line": line,
        "time": ColumnDataSource({"t": time}),
        **bands,
    }
    fill = CustomJS(args=arguments | {"quantities": list(QUANTITIES), "missing": _MISSING}, code=_FILL)
    source.selected.js_on_change("indices", fill)
    return plots


_FILL = """
const [column] = columns.selected.indices
if (column === undefined) return
const t = Array.from(time.data.t), n = t.length, q = packed.data
const half = n > 1 ? (t[1] - t[0]) / 2 : 0.5
const bands = {x_range, x_error, y_range, y_error, intensity_range, intensity_error}
function ribbon(low, high) {
    const out = {t: [], v: []}
    for (let i = 0; i < n;) {
        if (isNaN(low[i]) || isNaN(high[i])) { i++; continue }
        let j = i
        while (j < n && !isNaN(low[j]) && !isNaN(high[j])) j++
        if (out.t.length) { out.t.push(NaN); out.v.push(NaN) }
        if (j == i + 1) { out.t.push(t[i] - half / 2, t[i] + half / 2); out.v.push(low[i], low[i]) }
        else for (let k = i; k < j; k++) { out.t.push(t[k]); out.v.push(low[k]) }
        if (j == i + 1) { out.t.push(t[i] + half / 2, t[i] - half / 2); out.v.push(high[i], high[i]) }
        else for (let k = j - 1; k >= i; k--) { out.t.push(t[k]); out.v.push(high[k]) }
        i = j
    }
    return out
}
const shown = {t}
for (const name of quantities) {
    const unpack = (kind) => {
        const zero = scales.data[`${name}_${kind}_zero`][column], step = scales.data[`${name}_${kind}_step`][column]
        const numbers = q[`${name}_${kind}`]
        return t.map((_, i) => {
            const value = numbers[column * n + i]
            return value == missing ? NaN : zero + step * value
        })
    }
    const mean = unpack("mean"), error = unpack("error")
    shown[name] = mean
    bands[`${name}_error`].data = ribbon(mean.map((v, i) => v - error[i]), mean.map((v, i) => v + error[i]))
    if (`${name}_low` in q) bands[`${name}_range`].data = ribbon(unpack("low"), unpack("high"))
}
line.data = shown
"""


def _packed(series: xr.Dataset) -> tuple[ColumnDataSource, ColumnDataSource]:
    """Return the series of all columns as 16 bit numbers, one column after the other, and their zeros and steps."""
    kinds = ("mean", "error") if series.attrs["frames"] == 1 else ("mean", "error", "low", "high")
    packed: dict[str, Any] = {}
    scales: dict[str, Any] = {}
    for quantity in QUANTITIES:
        own = series.sel(quantity=quantity).transpose("column_id", "bin")
        for kind in kinds:
            name = f"{quantity}_{kind}"
            packed[name], scales[f"{name}_zero"], scales[f"{name}_step"] = quantised(own[kind].to_numpy())
    return ColumnDataSource(packed), ColumnDataSource(scales)


def quantised(values: NDArray[np.float64]) -> tuple[NDArray[np.int16], NDArray[np.float64], NDArray[np.float64]]:
    """Return rows of numbers in 16 bit: value = zero + step * number, with a step of 1/65534 of the row's range.

    Parameters
    ----------
    values
        (rows, points); what is not finite becomes -32768.

    Returns
    -------
    tuple
        The numbers one row after the other, and the zeros and steps of the rows.
    """
    known = np.isfinite(values)
    some = known.any(axis=1)
    low = np.where(some, np.min(values, axis=1, where=known, initial=np.inf), 0.0)
    high = np.where(some, np.max(values, axis=1, where=known, initial=-np.inf), 0.0)
    zero = (low + high) / 2
    step = np.where(high > low, (high - low) / _STEPS, 1.0)
    number = np.rint((np.where(known, values, zero[:, None]) - zero[:, None]) / step[:, None])
    return np.where(known, number, _MISSING).astype(np.int16).ravel(), zero, step


def frame_figures(run: Survey) -> list[figure]:
    """Return the curves over the frames: drift, and the share of accepted fits with the correlation of the frame."""
    curve = frame_curve(run.frames)
    data = {
        "t": curve["time"].to_numpy(),
        "share": 100 * curve["share"].to_numpy(),
        **{axis: run.scale * curve["drift"].sel(axis=axis).to_numpy() for axis in ("x", "y")},
    }
    if "quality" in curve:
        data["quality"] = 100 * curve["quality"].to_numpy()
    source = ColumnDataSource(data)
    drift = _curve_figure(f"drift ({run.unit})", run.time_unit)
    for axis, colour in zip(("x", "y"), LINES, strict=True):
        drift.line("t", axis, source=source, color=colour, line_width=1.6, legend_label=axis)
    drift.add_tools(_hover([("x", "@x{0.0}"), ("y", "@y{0.0}")], run.unit, drift))
    share = _curve_figure("%", run.time_unit, x_range=drift.x_range, y_range=Range1d(0, 103))
    share.line("t", "share", source=source, color=LINES[0], line_width=1.6, legend_label="accepted fits")
    tips = [("accepted", "@share{0.0} %")]
    if "quality" in data:
        share.line(
            "t", "quality", source=source, color=LINES[1], line_width=1.6, legend_label="correlation with the sum"
        )
        tips.append(("correlation", "@quality{0.0} %"))
    share.add_tools(_hover(tips, "", share))
    drift.x_range.start, drift.x_range.end = _limits(data["t"])
    for plot in (drift, share):
        plot.legend.update(orientation="horizontal", location="bottom_left", click_policy="mute", padding=4, margin=4)
    return [drift, share]


def column_figures(run: Survey, source: ColumnDataSource) -> list[figure]:
    """Return the spread of each column against its stated error, and its accepted share and R squared."""
    known = np.concatenate([run.columns["spread"], run.columns["expected"]])
    known = known[np.isfinite(known)]
    figures = []
    if np.isfinite(run.columns["excess"]).any():
        top = 1.08 * float(known.max())
        plot = _column_figure(f"stated error ({run.unit})", f"spread ({run.unit})")
        plot.line([0, top], [0, top], color=FINE, line_dash="dashed")
        _dots(plot, "expected", "spread", source, [("error", "@expected{0.00}"), ("spread", "@spread{0.00}")])
        plot.y_range.start, plot.x_range.start = 0, 0
        figures.append(plot)
    plot = _column_figure("accepted (%)", "R²")
    if "share" in source.data and "r_squared" in source.data:
        _dots(plot, "share", "r_squared", source, [("accepted", "@share{0.0} %"), ("R²", "@r_squared{0.00}")])
        figures.append(plot)
    return figures


def _curve_figure(label: str, time_unit: str, **ranges: Any) -> figure:
    return figure(
        tools=_TOOLS,
        x_axis_label=f"time ({time_unit})",
        y_axis_label=label,
        sizing_mode="stretch_width",
        height=230,
        **ranges,
    )


def _column_figure(x_label: str, y_label: str) -> figure:
    return figure(tools=_TOOLS, x_axis_label=x_label, y_axis_label=y_label, sizing_mode="stretch_width", height=300)


def _dots(plot: figure, x: str, y: str, source: ColumnDataSource, tips: list[tuple[str, str]]) -> None:
    """Draw a dot for each column, which can be chosen."""
    dots = plot.scatter(
        x,
        y,
        source=source,
        size=8,
        fill_color=LINES[0],
        fill_alpha=0.55,
        line_color=LINES[0],
        nonselection_fill_alpha=0.45,
        nonselection_line_alpha=0.8,
        selection_fill_color="#ff4d4d",
        selection_fill_alpha=1.0,
        selection_line_color="#ff4d4d",
    )
    plot.add_tools(HoverTool(renderers=[dots], tooltips=[("column", "@id @kind"), *tips]), TapTool(renderers=[dots]))


def _hover(tips: list[tuple[str, str]], unit: str, plot: figure) -> HoverTool:
    tips = [(name, f"{value} {unit}".strip()) for name, value in tips]
    return HoverTool(tooltips=[("time", "@t{0.000}"), *tips], mode="vline", renderers=plot.renderers[:1])


def _limits(time: NDArray[np.float64]) -> tuple[float, float]:
    pad = 0.01 * float(np.ptp(time)) or 0.5
    return float(time[0]) - pad, float(time[-1]) + pad


def make_plain(plot: figure) -> None:
    """Give a figure the look that all have on the page; its colours of text and lines are set there, light or dark."""
    plot.background_fill_alpha = plot.border_fill_alpha = 0.0
    plot.outline_line_color = None
    plot.toolbar.logo = None
    plot.toolbar.autohide = True
    plot.axis.axis_label_text_font_style = "normal"
    plot.axis.axis_label_text_font_size = "12px"
    plot.axis.major_label_text_font_size = "11px"
    plot.axis.minor_tick_line_color = None
    plot.min_border_right = 12
