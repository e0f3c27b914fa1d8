"""What the service was started with."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from ..settings import ClusterSettings
from .folders import STATE_FOLDER

LOOPBACK = ("127.0.0.1", "localhost", "::1")


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
        Folder of :func:`tract_dask.certificates.make_certificates`; None: plain HTTP.
    tokens
        Demand tokens on loopback too, where other users of the machine could connect.
    allowed_hosts
        Names, with their ports where those are not the scheme's own, under which browsers may ask for the service
        beside the one that it listens on: a reverse proxy's.
    trusted_proxy
        Address of the reverse proxy whose X-Forwarded-* headers are believed; "" believes none.
    max_body_bytes
        Largest body of a request.
    session_hours
        How long a browser stays logged in.
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

    @property
    def state(self) -> Path:
        """The folder of what the service itself keeps."""
        return self.data_root / STATE_FOLDER

    @property
    def database(self) -> Path:
        """The store of jobs, events, versions of columns, tokens and sessions."""
        return self.state / "service.sqlite"

    @property
    def jobs(self) -> Path:
        """The folder of the jobs' outputs, one folder a job, where the job names no other."""
        return self.data_root / "jobs"

    @property
    def needs_tokens(self) -> bool:
        """Whether every request has to say who it comes from."""
        return self.tokens or self.host not in LOOPBACK
