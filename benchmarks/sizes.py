"""How much is measured: the whole benchmark, or the small one that only shows that everything runs."""

from __future__ import annotations

from dataclasses import dataclass

QUARTER = 4


@dataclass(frozen=True)
class Size:
    """Amounts of data and repeats.

    Attributes
    ----------
    name
        ``full`` or ``small``.
    repeats
        Measurements of each figure; they alternate between what is compared.
    long_repeats
        The same, of stages and whole runs.
    windows
        Windows that a fast fitter gets in one measurement; a slow one gets a share of them.
    sides
        Windows' sides of the sweep, px.
    field
        Frames' sides, px.
    pixel_size_pm
        Of the simulated movie; with ``field`` it gives the number of columns.
    window_px
        Side of their windows.
    frames, stage_frames
        Of the whole run, and of the run whose stages are compared with bare loops.
    shares
        Parts of that movie that are run as well, as divisors of its length; memory is compared with a quarter, where
        that is among them.
    one_core
        Whether a run with everything on one core is measured too.
    sweep_columns
        Numbers of columns that the fit stage is measured with.
    shard_mb
        Size of a shard in whole runs, the same for movies of any length.
    shards
        Empty shards for the scheduler.
    cold
        Whether the first fit is measured without compiled kernels too.
    peers
        Whom to compare with; of the others, installing them takes longer than the small benchmark.
    """

    name: str
    repeats: int
    long_repeats: int
    windows: int
    sides: tuple[int, ...]
    field: int
    pixel_size_pm: float
    window_px: int
    frames: int
    stage_frames: int
    shares: tuple[int, ...]
    one_core: bool
    sweep_columns: tuple[int, ...]
    shard_mb: float
    shards: int
    cold: bool
    peers: tuple[str, ...]

    @property
    def frame_bytes(self) -> int:
        """Bytes of a frame."""
        return 2 * self.field**2


FULL = Size(
    name="full",
    repeats=3,
    long_repeats=1,
    windows=5000,
    sides=(15, 21, 25, 31, 41, 51, 71),
    field=2048,
    pixel_size_pm=3.28,
    window_px=51,
    frames=956,
    stage_frames=512,
    shares=(8, QUARTER, 2),
    one_core=True,
    sweep_columns=(25, 100, 200),
    shard_mb=256.0,
    shards=100_000,
    cold=True,
    peers=("picasso", "scipy", "lmfit", "atomap", "trackpy"),
)

SMALL = Size(
    name="small",
    repeats=1,
    long_repeats=1,
    windows=40,
    sides=(15,),
    field=256,
    pixel_size_pm=6.0,
    window_px=25,
    frames=16,
    stage_frames=16,
    shares=(),
    one_core=False,
    sweep_columns=(5,),
    shard_mb=1.0,
    shards=100,
    cold=False,
    peers=("scipy", "lmfit"),
)
