"""Every setting of every stage: frozen dataclasses that check themselves, and their TOML form.

A setting is declared once, here, with its default, unit, range and one sentence; the command line, the documentation
and the checks come from that declaration.
"""

from __future__ import annotations

import dataclasses
import math
import re
import tomllib
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import tomli_w

from .errors import SettingsError, shown

T = TypeVar("T")

MOST_ITEMS = 1000
"""Items of a setting that is a list."""

_LINE = r"[^\n\r]+"
_WORD = r"[A-Za-z0-9_.:,@+-]+"
_WORD_FORM = "letters, digits and _ . : , @ + -"


def setting(
    default: Any,
    description: str,
    *,
    unit: str = "",
    low: float | None = None,
    high: float | None = None,
    choices: tuple[str, ...] = (),
    flag: str = "",
    pattern: str = "",
    form: str = "",
    in_files_only: bool = False,
) -> Any:
    """Declare a setting: a dataclass field that carries its documentation and its range.

    ``flag`` names its option on the command line where that is not simply the field's name with dashes; a setting that
    is ``in_files_only`` has none. Text, or each text of a list, has to match ``pattern``, which ``form`` puts in words.
    """
    return field(
        default=default,
        metadata={
            "description": description,
            "unit": unit,
            "low": low,
            "high": high,
            "choices": choices,
            "flag": flag,
            "pattern": pattern,
            "form": form,
            "in_files_only": in_files_only,
        },
    )


def _subgroup(description: str) -> dict[str, Any]:
    """Return what a field that is a group of settings inside another carries: only a file can set it."""
    return dict(setting(None, description, in_files_only=True).metadata)


@dataclass(frozen=True)
class Settings:
    """A group of settings; construction checks every value.

    Raises
    ------
    SettingsError
        Naming the setting, its range or choices, and the value found.
    """

    def __post_init__(self) -> None:
        kinds = typing.get_type_hints(type(self))
        for item in dataclasses.fields(self):
            value = getattr(self, item.name)
            value = tuple(tuple(v) if isinstance(v, list) else v for v in value) if isinstance(value, list) else value
            if isinstance(value, int) and not isinstance(value, bool) and plain_type(kinds[item.name]) is float:
                value = float(value) if abs(value) < 2**1000 else math.inf
            object.__setattr__(self, item.name, value)
            if not isinstance(value, Settings):
                _check(type(self), item, kinds[item.name], value)


@dataclass(frozen=True)
class SourceSettings(Settings):
    """How to read a file that does not say enough about itself."""

    raw_shape: tuple[int, ...] | None = setting(
        None,
        "Frames, rows and columns of a raw binary file; frames 0 means as many as the file holds",
        unit="px",
    )
    raw_dtype: str | None = setting(None, "Pixel type of a raw binary file, such as uint16 or >f4")
    raw_offset: int = setting(0, "Bytes to skip at the start of a raw binary file", unit="bytes", low=0)


@dataclass(frozen=True)
class MetadataSettings(Settings):
    """What the user knows better than the file; unset means as the file says."""

    pixel_size_pm: float | None = setting(None, "Size of a pixel", unit="pm", low=1e-3, high=1e7)
    frame_time_s: float | None = setting(None, "Time from one frame to the next", unit="s", low=1e-12, high=1e6)
    dose: float | None = setting(None, "Electron dose of one frame", unit="e/A^2", low=0)
    gain: float = setting(1.0, "Electron counts for one detector unit", unit="counts", low=1e-12, high=1e12)


@dataclass(frozen=True)
class ConvertSettings(Settings):
    """The layout of movie.zarr."""

    shard_mb: float = setting(
        256.0, "Uncompressed size of a shard, the unit of writing and of work", unit="MB", low=1, high=4096
    )
    tile_px: int = setting(256, "Side of the tiles inside a shard", unit="px", low=16, high=8192)
    codec: str = setting("lz4", "Lossless compression: lz4 is fast, zstd is smaller", choices=("lz4", "zstd", "none"))


@dataclass(frozen=True)
class DriftSettings(Settings):
    """How the movement of the whole field is measured."""

    method: str = setting(
        "auto",
        "Measure the drift, read it from a CSV file, or take it as zero",
        choices=("auto", "csv", "none"),
        flag="--drift",
    )
    csv: str | None = setting(
        None, "CSV file with columns frame, y, x (drift in px), for method csv", flag="--drift-csv"
    )
    search_px: float | None = setting(
        None,
        "Largest step between two frames; unset: 0.4 of the shortest lattice period",
        unit="px",
        low=0.5,
        flag="--drift-search-px",
    )
    refine: bool = setting(
        True,
        "Correct the drift of each frame by the common motion of its fitted columns",
        flag="--drift-refine",
    )
    refine_columns: int = setting(10, "Fewest accepted columns of a frame for that correction", low=3)


@dataclass(frozen=True)
class ColumnSettings(Settings):
    """How the atomic columns are found in the summed image."""

    method: str = setting(
        "auto",
        "Find columns automatically, on lattices, at the positions of a CSV file, or by what stands out of the noise",
        choices=("auto", "lattice", "csv", "maxima", "blobs", "template"),
        flag="--columns-method",
    )
    csv: str | None = setting(None, "CSV file with columns x, y and optionally column_id, kind", flag="--columns")
    contrast: str = setting(
        "bright", "Columns are brighter or darker than their surroundings", choices=("bright", "dark")
    )
    lattices: tuple[Any, ...] = setting(
        (),
        "Lattices for method lattice: origin, a, a_count, b, b_count (positions in px), a_repeats, b_repeats, kind",
    )
    spacing_px: float | None = setting(None, "Distance between neighbouring columns; unset: measured", unit="px", low=2)
    search_radius_px: float | None = setting(
        None, "Radius of the local maximum around a seed; unset: a quarter of the spacing", unit="px", low=0
    )
    centroid_radius_px: float | None = setting(
        None, "Radius of the centroid around that maximum; unset: an eighth of the spacing", unit="px", low=1
    )
    min_amplitude: float = setting(
        0.15,
        "Weakest column that is kept, against the median amplitude",
        low=0,
        high=1,
        flag="--min-amplitude",
    )
    detection_threshold: float = setting(
        5.0, "Methods maxima, blobs, template: weakest column, in units of what noise alone shows", low=0, high=1e4
    )
    template: tuple[int, ...] | None = setting(
        None,
        "Method template: x, y of the column that the others look like; unset: the mean of the strongest",
        unit="px",
        flag="--template-at",
    )


@dataclass(frozen=True)
class FitSettings(Settings):
    """How a column is fitted in every frame."""

    window_px: int | None = setting(
        None, "Diameter of the round window that is fitted, odd; unset: half the spacing", unit="px", low=5, high=501
    )
    estimator: str = setting(
        "lsq",
        "Least squares on blurred pixels, or maximum likelihood on raw counts (poisson), best where contrast is high",
        choices=("lsq", "poisson"),
    )
    shape: str = setting(
        "fixed",
        "Sigmas and theta of a column stay as in the summed image, or are fitted in every frame (free, the paper's)",
        choices=("fixed", "free"),
    )
    filter: str = setting(
        "gaussian",
        "What frames go through before lsq fits: a Gaussian blur, a filter of the whole frame, or nothing",
        choices=("gaussian", "wiener", "tv-l1", "none"),
    )
    blur_sigma_px: float = setting(
        2.0,
        "Gaussian blur (the paper's 2 px) before columns, noise and lsq fits are looked at; 0 leaves pixels raw",
        unit="px",
        low=0,
        high=20,
    )
    wiener_background: float = setting(
        1.0,
        "Filter wiener: times that the radial background of the power spectrum is subtracted",
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
    sigma_factor: float = setting(
        1.3, "Free sigmas stay within this factor of those in the summed image", low=1.01, high=100
    )
    amplitude_factor: float = setting(
        5.0, "Amplitude stays below this factor of that in the summed image", low=1.01, high=1e6
    )
    threshold: float = setting(
        1.6, "Accept a fit where the amplitude exceeds this times the noise (the paper's 2)", low=0, high=100
    )
    counting: bool = setting(
        True, "For standard errors: the noise grows with the signal, as counts do; else it is the same in every pixel"
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

    def __post_init__(self) -> None:
        super().__post_init__()
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
        return 0.0 if self.estimator == "poisson" or self.filter != "gaussian" else self.blur_sigma_px

    @property
    def noise_blur_px(self) -> float:
        """Sigma of the blur before the noise is measured: none where whole frames are filtered."""
        return 0.0 if self.filters_frames else self.blur_sigma_px


@dataclass(frozen=True)
class SlurmSettings(Settings):
    """What is asked of SLURM for every job that holds workers."""

    queue: str | None = setting(None, "Partition", pattern=_WORD, form=_WORD_FORM)
    account: str | None = setting(None, "Account that is charged", pattern=_WORD, form=_WORD_FORM)
    walltime: str = setting(
        "01:00:00",
        "Time that a job may take; one that ends is followed by another while there is work",
        pattern=r"(\d+-)?\d+(:\d\d){0,2}",
        form="minutes, hours:minutes:seconds or days-hours, such as 02:00:00",
    )
    workers_per_job: int = setting(1, "Worker processes in one job, on one node", low=1, high=1024)
    directives: tuple[str, ...] = setting(
        (),
        "More options of sbatch, such as --constraint=avx512",
        pattern=r"-[^\n\r]+",
        form="options that begin with a dash",
    )
    prologue: tuple[str, ...] = setting(
        (),
        "Lines of shell that a job runs first, such as module load python",
        pattern=_LINE,
        form="single lines",
    )
    log_directory: str | None = setting(
        None,
        "Folder for what jobs print, which has to exist on the nodes; unset: the working folder",
        pattern=_LINE,
        form="a path",
    )


@dataclass(frozen=True)
class SshSettings(Settings):
    """Which machines are reached by ssh, and how."""

    hosts: tuple[str, ...] = setting(
        (),
        "Machines that workers are started on, as ssh names them; the file ~/.ssh/config holds for them",
        pattern=r"[A-Za-z0-9_.:@\[\]][A-Za-z0-9_.:@%\[\]-]*",
        form="names such as node1 or user@node1",
    )
    options: tuple[str, ...] = setting(
        (), "More arguments of ssh, such as -p and 2222", pattern=_LINE, form="single arguments"
    )


@dataclass(frozen=True)
class ClusterSettings(Settings):
    """Where the work runs; no result depends on it."""

    kind: str | None = setting(
        None,
        "What starts the workers: this machine, somebody else, SLURM or ssh; unset: local, or address if one is given",
        choices=("local", "address", "slurm", "ssh"),
        in_files_only=True,
    )
    scheduler: str | None = setting(None, "Address of a running Dask scheduler")
    scheduler_file: str | None = setting(None, "Scheduler file of a running Dask scheduler")
    workers: int | None = setting(
        None,
        "Worker processes: of the local cluster or of each ssh host (unset: one a core), or of all SLURM jobs",
        low=1,
        high=4096,
    )
    min_workers: int | None = setting(
        None,
        "Workers that SLURM keeps while there is no work, down from as many as workers says; unset: all of them",
        low=0,
        high=4096,
        in_files_only=True,
    )
    memory_limit: str | None = setting(
        None, "Memory of each worker that we start, such as 2GB; unset: its share of the machine"
    )
    threads: int = setting(
        1, "Threads of each worker that we start: tasks that share its memory", low=1, high=256, in_files_only=True
    )
    tls: str | None = setting(
        None,
        "Folder of certificates (tract-dask certs) with which everything between scheduler and workers is encrypted",
    )
    python: str | None = setting(
        None,
        "Interpreter of SLURM and ssh workers; unset: the path of this one",
        pattern=_LINE,
        form="a path on the nodes",
        in_files_only=True,
    )
    interface: str | None = setting(
        None,
        "Network interface on which our scheduler listens for SLURM and ssh workers; unset: that of the default route",
        pattern=_WORD,
        form="a name such as eth0",
        in_files_only=True,
    )
    local_directory: str | None = setting(
        None,
        "Scratch folder of the workers that we start; unset: the system's",
        pattern=_LINE,
        form="a path",
        in_files_only=True,
    )
    patience_s: float | None = setting(
        None,
        "How long work waits for a worker when there is none; unset: 60, or a day with SLURM, where jobs queue",
        unit="s",
        low=1,
        in_files_only=True,
    )
    slurm: SlurmSettings = field(default_factory=SlurmSettings, metadata=_subgroup("What is asked of SLURM"))
    ssh: SshSettings = field(default_factory=SshSettings, metadata=_subgroup("Which machines are reached"))

    def __post_init__(self) -> None:
        super().__post_init__()
        named = [name for name in ("scheduler", "scheduler_file") if getattr(self, name)]
        needed = {
            "address": ("scheduler or scheduler_file", bool(named)),
            "slurm": ("workers and memory_limit", bool(self.workers and self.memory_limit)),
            "ssh": ("hosts in the table [ssh]", bool(self.ssh.hosts)),
        }
        what, found = needed.get(self.resolved_kind, ("", True))
        if not found:
            raise _contradiction("kind", what, f"kind = {self.kind!r} without", "Say them")
        if named and self.resolved_kind != "address":
            raise _contradiction(
                named[0], "kind = 'address', or none", f"kind = {self.kind!r}", "Leave the scheduler or the kind out"
            )
        if self.min_workers is not None and self.min_workers > (self.workers or 0):
            raise _contradiction(
                "min_workers", f"at most workers, {self.workers}", str(self.min_workers), "Make it smaller"
            )

    @property
    def resolved_kind(self) -> str:
        """The kind that is set, or else the one that the other settings mean."""
        return self.kind or ("address" if self.scheduler or self.scheduler_file else "local")

    @property
    def resolved_patience_s(self) -> float:
        """How long work waits for a worker, in s: as set, or as is usual for the kind."""
        return self.patience_s or (86400.0 if self.resolved_kind == "slurm" else 60.0)


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


def to_dict(settings: Settings) -> dict[str, Any]:
    """Return the settings as nested mappings, without those that are unset."""
    return {
        item.name: to_dict(value) if isinstance(value, Settings) else value
        for item in dataclasses.fields(settings)
        if (value := getattr(settings, item.name)) is not None
    }


def to_toml(settings: Settings) -> str:
    """Return the settings as TOML text.

    Examples
    --------
    >>> from_toml(FitSettings, to_toml(FitSettings(window_px=31))).window_px
    31
    """
    return tomli_w.dumps(to_dict(settings))


def from_toml(kind: type[T], text: str, where: str = "settings") -> T:
    """Return settings of class ``kind`` from TOML text.

    Raises
    ------
    SettingsError
        Where the text is not TOML, or names a setting that does not exist, or a value is out of range.
    """
    try:
        values = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(
            "this is not valid TOML", where, got=str(error), remedy="Mend the line that it names"
        ) from error
    return from_dict(kind, values, where)


def from_dict(kind: type[T], values: dict[str, Any], where: str = "settings") -> T:
    """Return settings of class ``kind`` from nested mappings; see :func:`from_toml`."""
    kinds = typing.get_type_hints(kind)
    names = [item.name for item in dataclasses.fields(kind)]  # type: ignore[arg-type]
    arguments: dict[str, Any] = {}
    for name, value in values.items():
        if name not in names:
            raise SettingsError(
                f"there is no setting {name!r}",
                where,
                f"one of {', '.join(names)}",
                name,
                "Correct its name; docs/settings.md lists them all",
            )
        nested = isinstance(kinds[name], type) and issubclass(kinds[name], Settings)
        if nested and not isinstance(value, dict):
            raise SettingsError(
                f"{name!r} is a group of settings", where, f"a table [{name}]", shown(value), "Give it a table"
            )
        arguments[name] = from_dict(kinds[name], value, f"{where} [{name}]") if nested else value
    return kind(**arguments)


def load(path: Path) -> RunSettings:
    """Return the settings in a TOML file, such as the run.toml that every run writes.

    Raises
    ------
    SettingsError
        As :func:`from_toml`, and where the file cannot be read.
    """
    return from_toml(RunSettings, _text(path), str(path))


def load_cluster(path: Path) -> ClusterSettings:
    """Return the settings of a cluster in a TOML file of its own.

    Raises
    ------
    SettingsError
        As :func:`load`.
    """
    return from_toml(ClusterSettings, _text(path), str(path))


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SettingsError(
            "the settings file cannot be read", str(path), "a TOML file", str(error), "Check its path"
        ) from error


def plain_type(annotation: Any) -> Any:
    """Return the plain type behind ``X | None`` and ``tuple[...]``."""
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        annotation = next(arg for arg in typing.get_args(annotation) if arg is not type(None))
    return typing.get_origin(annotation) or annotation


def is_optional(annotation: Any) -> bool:
    """Tell whether a setting's annotation admits None."""
    return type(None) in typing.get_args(annotation)


def _check(owner: type, item: dataclasses.Field[Any], annotation: Any, value: Any) -> None:
    meta = item.metadata
    where = f"setting {item.name} ({owner.__name__})"
    if value is None and is_optional(annotation):
        return
    kind = plain_type(annotation)
    if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
        raise SettingsError(
            "the value is of the wrong type", where, kind.__name__, shown(value), meta.get("description", "")
        )
    if isinstance(value, tuple):
        _check_items(where, meta, annotation, value)
    if meta.get("choices") and value not in meta["choices"]:
        raise SettingsError(
            "there is no such choice",
            where,
            f"one of {', '.join(meta['choices'])}",
            shown(value),
            meta["description"],
        )
    if meta.get("pattern"):
        _check_text(where, meta, (value,) if isinstance(value, str) else value)
    low, high = meta.get("low"), meta.get("high")
    if isinstance(value, int | float) and not ((low is None or value >= low) and (high is None or value <= high)):
        bounds = " and ".join(
            part
            for part in (
                f"at least {low:g}" if low is not None else "",
                f"at most {high:g}" if high is not None else "",
            )
            if part
        )
        raise SettingsError(
            "the value is out of range",
            where,
            f"{bounds} {meta['unit']}".strip(),
            shown(value),
            meta["description"],
        )
    if isinstance(value, float) and not math.isfinite(value):
        raise SettingsError("the value is not finite", where, "a number", repr(value), meta["description"])


def _check_items(where: str, meta: Mapping[str, Any], annotation: Any, value: tuple[Any, ...]) -> None:
    """Check that a list is not too long, and that whole numbers are such where it holds whole numbers."""
    if len(value) > MOST_ITEMS:
        raise SettingsError("the list is too long", where, f"at most {MOST_ITEMS}", str(len(value)), "Shorten it")
    listed = next((arg for arg in typing.get_args(annotation) if typing.get_origin(arg) is tuple), annotation)
    if int in typing.get_args(listed) and not all(type(item) is int and abs(item) < 2**63 for item in value):
        raise SettingsError(
            "the list holds something else", where, "whole numbers", shown(list(value)), meta["description"]
        )


def _check_text(where: str, meta: Mapping[str, Any], texts: Iterable[Any]) -> None:
    for text in texts:
        if not isinstance(text, str) or not re.fullmatch(meta["pattern"], text):
            raise SettingsError("the text has another form", where, meta["form"], shown(text), meta["description"])


def _contradiction(name: str, expected: str, got: str, remedy: str) -> SettingsError:
    return SettingsError("settings contradict each other", f"setting {name} (ClusterSettings)", expected, got, remedy)
