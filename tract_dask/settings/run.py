"""Every setting of every stage: frozen dataclasses that check themselves, and their TOML form.

A setting is declared once, here, with its default, unit, range and one sentence; the command line, the documentation
and the checks come from that declaration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

from ..errors import SettingsError
from .cluster import ClusterSettings
from .declare import Settings, setting


@dataclass(frozen=True)
class SourceSettings(Settings):
    """What is read of a movie, and how to read a raw file, which does not describe itself."""

    raw_shape: tuple[int, ...] | None = setting(
        None,
        "Frames, rows and columns of a raw binary file; frames 0 means as many as the file holds",
        unit="px",
    )
    raw_dtype: str | None = setting(None, "Pixel type of a raw binary file, such as uint16 or >f4")
    raw_offset: int = setting(0, "Bytes to skip at the start of a raw binary file", unit="bytes", low=0)
    frames: str | None = setting(
        None, "Read these frames only: start:stop or start:stop:step, such as 100:2000:2", common=True
    )
    roi: str | None = setting(None, "Read this field only: y0:y1,x0:x1, such as 0:512,256:768", unit="px", common=True)
    bin: int = setting(1, "Sum the pixels of squares with this side", unit="px", low=1, high=64, common=True)


@dataclass(frozen=True)
class MetadataSettings(Settings):
    """Values that replace those of the file; unset: the file's."""

    pixel_size_pm: float | None = setting(None, "Size of a pixel", unit="pm", low=1e-3, high=1e7, common=True)
    frame_time_s: float | None = setting(
        None, "Time from one frame to the next", unit="s", low=1e-12, high=1e6, common=True
    )
    dose: float | None = setting(None, "Electron dose of one frame", unit="e/A^2", low=0, common=True)
    gain: float | str = setting(
        1.0,
        "Electron counts for one detector unit; auto: measured from the noise",
        unit="counts",
        low=1e-12,
        high=1e12,
        words=("auto",),
        common=True,
    )
    offset: float | str = setting(
        0.0,
        "Detector units of a pixel without electrons; auto: measured from the noise",
        unit="detector units",
        low=-1e12,
        high=1e12,
        words=("auto",),
        common=True,
    )


def is_step_of(step_s: float, frame_time_s: float | None) -> bool:
    """Tell whether time stamps with this usual step have this frame time, so that they are the times of the frames.

    Stamps are kept to a nanosecond. Another frame time is one that the user gave: it counts more than the stamps.
    """
    return frame_time_s is not None and math.isclose(step_s, frame_time_s, rel_tol=1e-6, abs_tol=2e-9)


@dataclass(frozen=True)
class ConvertSettings(Settings):
    """The layout of movie.zarr."""

    shard_mb: float = setting(
        256.0, "Uncompressed size of a shard, the unit of writing and of work", unit="MB", low=1, high=4096
    )
    tile_px: int = setting(256, "Side of the tiles inside a shard", unit="px", low=16, high=8192)
    codec: str = setting("lz4", "Lossless compression: lz4 is fast, zstd is smaller", choices=("lz4", "zstd", "none"))
    find_defects: bool = setting(True, "Find hot and dead pixels, spikes, dead lines and borders, and leave them out")
    dark: str | None = setting(None, "Image without electrons, or several: their mean is subtracted from every frame")
    gain_reference: str | None = setting(
        None, "Gain reference: every frame is multiplied by it, after the dark image is subtracted"
    )
    gain_reference_by: str = setting(
        "multiply",
        "Multiply frames by the gain reference, or divide them by it, as by the image of an even beam (a flat field)",
        choices=("multiply", "divide"),
    )
    defects: str | None = setting(
        None, "Faulty pixels, to be left out: a list of x, y (.csv, .txt), or an image that is 0 where pixels are good"
    )


@dataclass(frozen=True)
class DriftSettings(Settings):
    """How the movement of the whole field is measured."""

    method: str = setting(
        "auto",
        "Measure the drift, read it from a CSV file, or take it as zero",
        choices=("auto", "csv", "none"),
        grouped=True,
        common=True,
    )
    csv: str | None = setting(
        None, "CSV file with columns frame, y, x (drift in px), for method csv", grouped=True, common=True
    )
    search_px: float | None = setting(
        None,
        "Largest step between two frames; unset: 0.4 of the shortest lattice period",
        unit="px",
        low=0.5,
        grouped=True,
    )


@dataclass(frozen=True)
class ColumnSettings(Settings):
    """How the atomic columns are found in the summed image."""

    method: str = setting(
        "auto",
        "auto: on the image's lattice; lattice: on lattices; csv: a table; maxima, blobs, template: peak detectors",
        choices=("auto", "lattice", "csv", "maxima", "blobs", "template"),
        grouped=True,
        common=True,
    )
    csv: str | None = setting(
        None, "CSV file with columns x, y and optionally column_id, kind", grouped=True, common=True
    )
    contrast: str = setting(
        "auto",
        "Columns are brighter or darker than their surroundings; auto: what the summed image speaks for",
        choices=("auto", "bright", "dark"),
        common=True,
    )
    lattices: tuple[Any, ...] = setting(
        (),
        "Lattices for method lattice: origin, a, a_count, b, b_count (positions in px), a_repeats, b_repeats, kind",
        common=True,
    )
    spacing_px: float | None = setting(
        None, "Distance between neighbouring columns; unset: measured", unit="px", low=2, common=True
    )
    search_radius_px: float | None = setting(
        None, "Radius of the local maximum around a seed; unset: a quarter of the spacing", unit="px", low=0
    )
    centroid_radius_px: float | None = setting(
        None, "Radius of the centroid around that maximum; unset: an eighth of the spacing", unit="px", low=1
    )
    min_amplitude: float = setting(0.15, "Weakest column that is kept, against the median amplitude", low=0, high=1)
    detection_threshold: float = setting(
        5.0, "Methods maxima, blobs, template: weakest column, in units of the peaks of noise alone", low=0, high=1e4
    )
    template: tuple[int, ...] | None = setting(
        None,
        "Method template: x, y of an example column; unset: the mean of the strongest",
        unit="px",
    )


@dataclass(frozen=True)
class FitSettings(Settings):
    """How a column is fitted in every frame."""

    window_px: int | None = setting(
        None,
        "Diameter of the round window that is fitted, odd; unset: half the spacing",
        unit="px",
        low=5,
        high=501,
        common=True,
    )
    estimator: str = setting(
        "lsq",
        "Least squares on blurred pixels, or maximum likelihood on raw counts (poisson), best where contrast is high",
        choices=("lsq", "poisson"),
        common=True,
    )
    shape: str = setting(
        "fixed",
        "Sigmas and theta of a column stay as in the summed image, or are fitted in every frame (free, the paper's)",
        choices=("fixed", "free"),
        common=True,
    )
    filter: str = setting(
        "gaussian",
        "Filter before lsq fits: a Gaussian blur, a filter of the whole frame (wiener, tv-l1), or none",
        choices=("gaussian", "wiener", "tv-l1", "none"),
        common=True,
    )
    blur_sigma_px: float | None = setting(
        None,
        "Sigma of the Gaussian blur before columns, noise and lsq fits (paper: 2); unset: about 0.4 of the columns'"
        " sigma, as 0, 0.5, 1 or 2 px; 0: no blur",
        unit="px",
        low=0,
        high=20,
        common=True,
    )
    wiener_background: float = setting(
        1.0,
        "Filter wiener: factor of the radial background that is subtracted from the power spectrum",
        low=0,
        high=100,
    )
    wiener_cutoff: float = setting(
        0.3,
        "Filter wiener: frequency at which its low pass halves the power, in units of half a cycle a pixel",
        low=0.01,
        high=100,
    )
    tv_fidelity: float = setting(
        0.9,
        "Filter tv-l1: weight of fidelity; a disc is removed where its radius is below 2 over this",
        unit="1/px",
        low=1e-3,
        high=100,
    )
    tv_iterations: int = setting(200, "Filter tv-l1: most iterations", low=1, high=100000)
    mask_radius_px: float | None = setting(
        None,
        "Radius of the centroid's mask; unset: 1.894 of the column's sigma, with which its noise is least",
        unit="px",
        low=1.5,
    )
    max_shift_px: float | None = setting(
        None,
        "Farthest a column may be from its place in the summed image; unset: a quarter of the window",
        unit="px",
        low=0.1,
    )
    search_px: float | None = setting(
        None,
        "How far from its place a column that has left it is searched for; unset: 1.15 windows; 0: it is not",
        unit="px",
        low=0,
    )
    sigma_factor: float = setting(
        1.3, "Free sigmas stay within this factor of those in the summed image", low=1.01, high=100
    )
    amplitude_factor: float = setting(
        5.0, "Amplitude stays below this factor of that in the summed image", low=1.01, high=1e6
    )
    threshold: float = setting(
        1.6,
        "Accept a fit where the amplitude exceeds this times the noise; the default lets 5 % of empty places pass",
        low=0,
        high=100,
        common=True,
    )
    counting: bool = setting(
        True, "For standard errors: noise that grows with the signal, as in counts; off: the same noise in every pixel"
    )
    intensity_scale: str = setting(
        "paper",
        "Share of a Gaussian inside two sigma: the paper's box (0.9111) or the ellipse (0.8647)",
        choices=("paper", "ellipse"),
    )
    vacuum_box: tuple[int, ...] | None = setting(
        None,
        "Empty region for the noise: y0, y1, x0, x1 in the summed image; unset: found automatically",
        unit="px",
    )
    tolerance_px: float = setting(
        1e-4, "A fit has converged when its position moves less than this", unit="px", low=1e-8, high=0.1
    )
    max_iterations: int = setting(50, "Most iterations of one fit", low=1, high=10000)
    refine_drift: bool = setting(True, "Correct the drift of each frame by the common motion of its fitted columns")
    refine_columns: int = setting(10, "Fewest accepted columns of a frame for that correction", low=3)
    drift_columns: tuple[int, ...] | None = setting(
        None, "IDs of the columns that stand still by definition; unset: the largest part that keeps its distances"
    )

    scan_rows: str = setting(
        "off",
        "Free x of columns from the offsets of single rows of scanned frames (STEM): against their places in the summed"
        " image (sum), or on a lattice, for few frames",
        choices=("off", "sum", "lattice"),
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.scan_rows != "off" and self.filters_frames:
            raise SettingsError(
                "a filter of whole frames hides the offsets of rows",
                "setting scan_rows (FitSettings)",
                "filter gaussian or none",
                repr(self.filter),
                "Choose another filter, or scan_rows off",
            )
        if self.scan_rows != "off" and self.shape == "free":
            raise SettingsError(
                "displaced rows are in the widths of single frames, too, and offsets are found by known widths",
                "setting scan_rows (FitSettings)",
                "shape fixed",
                repr(self.shape),
                "Choose shape fixed, or scan_rows off",
            )
        if self.estimator == "poisson" and self.filters_frames:
            raise SettingsError(
                "filtered frames are not counts",
                "setting filter (FitSettings)",
                "gaussian or none, which leave the windows of the estimator poisson raw",
                repr(self.filter),
                "Choose the estimator lsq, or another filter",
            )

    @property
    def filters_frames(self) -> bool:
        """Whether the filter needs the whole frame, and makes standard errors unknown."""
        return self.filter in ("wiener", "tv-l1")

    @property
    def window_blur_px(self) -> float:
        """Sigma of the blur that windows go through before they are fitted: none where counts are."""
        return 0.0 if self.estimator == "poisson" or self.filter != "gaussian" else self._known_blur_px

    @property
    def noise_blur_px(self) -> float:
        """Sigma of the blur before the noise is measured: none where whole frames are filtered."""
        return 0.0 if self.filters_frames else self._known_blur_px

    @property
    def _known_blur_px(self) -> float:
        if self.blur_sigma_px is None:
            raise ValueError("the blur follows the columns: their sigma is needed first")
        return self.blur_sigma_px


@dataclass(frozen=True)
class RunSettings(Settings):
    """All settings of a run."""

    source: SourceSettings = field(default_factory=SourceSettings)
    metadata: MetadataSettings = field(default_factory=MetadataSettings)
    convert: ConvertSettings = field(default_factory=ConvertSettings)
    drift: DriftSettings = field(default_factory=DriftSettings)
    columns: ColumnSettings = field(default_factory=ColumnSettings)
    fit: FitSettings = field(default_factory=FitSettings)
    cluster: ClusterSettings = field(default_factory=ClusterSettings)


TITLES = {
    "source": "Reading",
    "metadata": "Metadata (otherwise as the file says)",
    "convert": "Conversion",
    "drift": "Drift",
    "columns": "Columns",
    "fit": "Fit",
    "cluster": "Cluster (otherwise a local one)",
}
"""Headings of the groups, by the name of the group in :class:`RunSettings`."""
