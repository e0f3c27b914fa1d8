"""Settings of clusters."""

from __future__ import annotations

from dataclasses import dataclass, field

from .declare import LINE, WORD, WORD_FORM, Settings, contradiction, setting, subgroup


@dataclass(frozen=True)
class SlurmSettings(Settings):
    """What is asked of SLURM for every job that holds workers."""

    queue: str | None = setting(None, "Partition", pattern=WORD, form=WORD_FORM)
    account: str | None = setting(None, "Account that is charged", pattern=WORD, form=WORD_FORM)
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
        pattern=LINE,
        form="single lines",
    )
    log_directory: str | None = setting(
        None,
        "Folder for what jobs print, which has to exist on the nodes; unset: the working folder",
        pattern=LINE,
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
        (), "More arguments of ssh, such as -p and 2222", pattern=LINE, form="single arguments"
    )


@dataclass(frozen=True)
class ClusterSettings(Settings):
    """Where the work runs; no result depends on it."""

    kind: str | None = setting(
        None,
        "Where workers run: this machine, a running cluster, SLURM or ssh; unset: local, or address if one is given",
        choices=("local", "address", "slurm", "ssh"),
        in_files_only=True,
    )
    scheduler: str | None = setting(None, "Address of a running Dask scheduler", common=True)
    scheduler_file: str | None = setting(None, "Scheduler file of a running Dask scheduler")
    workers: int | None = setting(
        None,
        "Worker processes: of the local cluster or of each ssh host (unset: one a core), or of all SLURM jobs",
        low=1,
        high=4096,
        common=True,
    )
    min_workers: int | None = setting(
        None,
        "Workers that SLURM keeps while there is no work, down from as many as workers says; unset: all of them",
        low=0,
        high=4096,
        in_files_only=True,
    )
    memory_limit: str | None = setting(
        None, "Memory of each worker that we start, such as 2GB; unset: its share of the machine", common=True
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
        pattern=LINE,
        form="a path on the nodes",
        in_files_only=True,
    )
    interface: str | None = setting(
        None,
        "Network interface on which our scheduler listens for SLURM and ssh workers; unset: that of the default route",
        pattern=WORD,
        form="a name such as eth0",
        in_files_only=True,
    )
    local_directory: str | None = setting(
        None,
        "Scratch folder of the workers that we start; unset: the system's",
        pattern=LINE,
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
    slurm: SlurmSettings = field(default_factory=SlurmSettings, metadata=subgroup("What is asked of SLURM"))
    ssh: SshSettings = field(default_factory=SshSettings, metadata=subgroup("Which machines are reached"))

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
            raise contradiction("kind", what, f"kind = {self.kind!r} without", "Set them")
        if named and self.resolved_kind != "address":
            raise contradiction(
                named[0], "kind = 'address', or none", f"kind = {self.kind!r}", "Leave the scheduler or the kind out"
            )
        if self.min_workers is not None and self.min_workers > (self.workers or 0):
            raise contradiction(
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
