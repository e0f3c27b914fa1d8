"""What the service was started with."""

from __future__ import annotations

import hashlib
import os
import re
import stat
from dataclasses import dataclass, field
from pathlib import Path

from ..settings.cluster import ClusterSettings
from .data_root import STATE_FOLDER, DataRoot

LOOPBACK = ("127.0.0.1", "localhost", "::1")

DATABASE, LOCK = "service.sqlite", ".tract_dask.lock"


@dataclass(frozen=True)
class ServiceConfig:
    """What the service was started with.

    Attributes
    ----------
    data_root
        The folder with the movies; no request reads or writes outside of it.
    host, port
        Where it listens.
    concurrency
        Jobs that run at the same time.
    cluster
        Where jobs run.
    certificates
        Folder of :func:`tract_dask.cluster.certificates.make_certificates`; None: plain HTTP.
    tokens
        Demand tokens on loopback too, where other users of the machine could connect.
    allowed_hosts
        Names, with their ports where those are not the scheme's own, under which browsers may ask for the service
        beside the one that it listens on: a reverse proxy's.
    trusted_proxy
        Address of the reverse proxy whose X-Forwarded-* headers are believed; "" believes none.
    max_body_bytes
        Largest body of a request with a table of columns; others may have 1 MiB.
    session_hours
        How long a browser stays logged in.
    state_dir
        The folder of what the service itself keeps; None: :func:`state_folder` of the data root.
    """

    data_root: Path
    host: str = "127.0.0.1"
    port: int = 8000
    concurrency: int = 1
    cluster: ClusterSettings = field(default_factory=ClusterSettings)
    certificates: Path | None = None
    tokens: bool = False
    allowed_hosts: tuple[str, ...] = ()
    trusted_proxy: str = ""
    max_body_bytes: int = 32 << 20
    session_hours: float = 12.0
    state_dir: Path | None = None

    @property
    def state(self) -> Path:
        """The folder of what the service itself keeps: secrets are among it, so it lies outside of the data root."""
        return self.state_dir or state_folder(self.data_root)

    @property
    def root(self) -> DataRoot:
        """The data root, closed where the service's own folder is.

        Raises
        ------
        DestinationError
            Where it is no folder.
        """
        return DataRoot(self.data_root, (self.state,))

    @property
    def lock(self) -> Path:
        """Held by the service that works on the data root, wherever its own folder is."""
        return self.data_root / LOCK

    @property
    def database(self) -> Path:
        """The store of jobs, events, versions of columns, tokens and sessions."""
        return self.state / DATABASE

    @property
    def jobs(self) -> Path:
        """The folder of the jobs' outputs, one folder a job, where the job names no other."""
        return self.data_root / "jobs"

    @property
    def needs_tokens(self) -> bool:
        """Whether every request has to say who it comes from."""
        return self.tokens or self.host not in LOOPBACK


def state_folder(data_root: Path, *, known: bool = True) -> Path:
    """Return the folder of a data root's service under XDG_STATE_HOME, by default ``~/.local/state``.

    With ``known`` it is the folder ``.tract_dask`` of the data root where an earlier version has left the jobs there,
    and none are here.
    """
    root = Path(os.path.realpath(data_root))
    name = re.sub(r"[^A-Za-z0-9._-]+", "_", root.name)[:40] or "root"
    number = hashlib.sha256(os.fsencode(root)).hexdigest()[:10]
    home = Path(os.environ.get("XDG_STATE_HOME", ""))
    states = home if home.is_absolute() else Path.home() / ".local" / "state"
    place, old = states / "tract_dask" / f"{name}-{number}", root / STATE_FOLDER
    return old if known and not (place / DATABASE).exists() and _is_ours(old) else place


def _is_ours(folder: Path) -> bool:
    """Tell whether a folder holds a database, and nobody but this process's user could put it there."""
    try:
        status = folder.lstat()
    except OSError:
        return False
    private = stat.S_ISDIR(status.st_mode) and status.st_uid == os.geteuid() and not status.st_mode & 0o022
    return private and (folder / DATABASE).is_file()
