"""The service as a process: what is checked before it starts, what it says, and how it stops."""

from __future__ import annotations

import errno
import logging
import os
import socket
import sys
from collections.abc import Callable
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from urllib.parse import urlsplit

import uvicorn
from fastapi import FastAPI

from ..cluster.certificates import EXPIRES_SOON_DAYS, SERVICE, SERVICE_KEY, check_certificates
from ..cluster.forkserver import uncollected
from ..errors import DestinationError, InputError
from ..store.locks import sole_use
from .auth.headers import host_name
from .auth.tokens import Access, Role, Token
from .config import DATABASE, LOCK, LOOPBACK, ServiceConfig, state_folder
from .data_root import STATE_FOLDER, DataRoot
from .event_streams import EventStreams
from .jobs.store import JobStore

SHUTDOWN_S = 3
"""How long requests may take to end."""

SWITCH_S = 1e-3
"""For so long a thread may hold Python's lock while the requests' thread waits; several times in each request."""

_BACKLOG = 512
_TAKEN = "another service works on this data root"


def serve(config: ServiceConfig, say: Callable[[str], None]) -> None:
    """Run the service until it is interrupted; everything is checked before anything starts.

    Parameters
    ----------
    config
        With port 0 the system chooses one.
    say
        Takes what the user should read, line by line.

    Raises
    ------
    DestinationError
        Where the data root is missing, cannot be written, or is another service's; or the port is taken.
    InputError
        Where others could connect and there are no tokens, or the certificates cannot be used.
    """
    config = settled(config)
    prepare_state(config)
    with (
        sole_use(config.lock, _TAKEN, patience_s=1.0),  # the runner has one of its own, for any application
        closing(listen(config.host, config.port)) as listener,
    ):
        config = replace(config, port=listener.getsockname()[1])
        notes = check_access(config) + check_traffic(config) + check_state(config)
        app = make_application(config)
        sys.setswitchinterval(SWITCH_S)
        logging.basicConfig(format="%(asctime)s %(levelname)-7s %(message)s", level=logging.WARNING)
        logging.getLogger(__package__).setLevel(logging.INFO)
        for line in banner(config, notes):
            say(line)
        server = _Server(_settings(config, app), app.state.services.streams)
        with suppress(KeyboardInterrupt):  # uvicorn repeats the signal that it stopped for
            server.run(sockets=[listener])
        say("Stopped. Jobs that were running go on when the service starts again.")


def make_application(config: ServiceConfig) -> FastAPI:
    """Return the application with all that its first requests would have to wait for.

    The framework makes the checks of a route, and the document of the API, when they are first asked for. That takes
    most of a second, in which nothing else is answered; to look for garbage in the whole application, a tenth.
    """
    with uncollected():
        from .app import create_app

        app = create_app(config)
        app.openapi()
    return app


class _Server(uvicorn.Server):
    """Ends the streams of events when it stops, since uvicorn waits for requests to end by themselves."""

    def __init__(self, config: uvicorn.Config, streams: EventStreams) -> None:
        super().__init__(config)
        self._streams = streams

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        """Stop to listen, and let all requests end."""
        self._streams.close()
        await super().shutdown(sockets)


def settled(config: ServiceConfig) -> ServiceConfig:
    """Return the configuration with whole paths, links followed, and the state folder that it means.

    Raises
    ------
    DestinationError
        Where the data root is no folder.
    """
    root = DataRoot(config.data_root).path
    return replace(config, data_root=root, state_dir=Path(os.path.realpath(config.state)))


def prepare_state(config: ServiceConfig) -> None:
    """Make the folder of what the service keeps, for its user only.

    Raises
    ------
    DestinationError
        Where it, or the data root, cannot be written; or where an earlier version has left the jobs elsewhere.
    """
    old = config.data_root / STATE_FOLDER
    if not config.database.exists() and (old / DATABASE).is_file():
        raise DestinationError(
            "the jobs and tokens of this data root are in another folder",
            str(old),
            str(config.state),
            remedy=f"Move it: mv {old} {config.state}; or delete it, and begin without them",
        )
    _check_writable(config.data_root, "the data root", "--data-root")
    try:
        config.state.mkdir(mode=0o700, parents=True, exist_ok=True)
        config.state.chmod(0o700)
    except OSError as error:
        raise _not_writable(config.state, "the state folder", "--state-dir", error) from error
    _check_writable(config.state, "the state folder", "--state-dir")


def _check_writable(folder: Path, what: str, option: str) -> None:
    probe = folder / f".probe.{os.getpid()}"
    try:
        probe.touch()
        probe.unlink()
        if folder.joinpath(LOCK).exists() and not os.access(folder / LOCK, os.W_OK):
            raise PermissionError(errno.EACCES, f"{LOCK} is of another user's service")
    except OSError as error:
        raise _not_writable(folder, what, option, error) from error


def _not_writable(folder: Path, what: str, option: str, error: OSError) -> DestinationError:
    return DestinationError(
        f"{what} cannot be written",
        str(folder),
        "a folder that the service's user may write to",
        error.strerror or str(error),
        f"Change its owner or mode, or name another with {option}",
    )


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens.

    Raises
    ------
    DestinationError
        Where the address is not this machine's, or the port is taken or not allowed.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, kind, protocol)
    except OSError as error:
        raise DestinationError(
            "this host is not known", f"--host {host}", got=str(error), remedy="Name an address of this machine"
        ) from error
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen(_BACKLOG)
    except OSError as error:
        listener.close()
        raise _cannot_listen(host, port, error) from error
    return listener


def _cannot_listen(host: str, port: int, error: OSError) -> DestinationError:
    remedies = {
        errno.EADDRINUSE: "Stop the program that has it, or choose another with --port; 0 takes a free one",
        errno.EACCES: "Choose a port of 1024 or more with --port",
        errno.EADDRNOTAVAIL: "Name an address of this machine with --host",
    }
    return DestinationError(
        "the service cannot listen here",
        f"{host}:{port}",
        got=error.strerror or str(error),
        remedy=remedies.get(error.errno or 0, "Choose another with --host and --port"),
    )


def check_access(config: ServiceConfig) -> list[str]:
    """Check that tokens and certificates are there where they are needed; return what the user should know.

    Raises
    ------
    InputError
        Where tokens are demanded and there are none, or the certificates cannot be used.
    """
    notes = []
    if config.needs_tokens and not any(token.role != Role.MONITOR for token in tokens_in_use(config)):
        raise InputError(
            "requests need a token, and there is none",
            f"--host {config.host}" if config.host not in LOOPBACK else "--tokens",
            "one token or more",
            "none",
            f"Make one with: tract-dask token create NAME {_named(config)}",
        )
    if config.certificates is not None:
        certificate = check_certificates(config.certificates, SERVICE)
        if certificate.days_left < EXPIRES_SOON_DAYS:
            notes.append(f"The certificate expires in {certificate.days_left} days; tract-dask certs renews it then.")
    elif config.host not in LOOPBACK and not config.trusted_proxy:
        notes.append("Tokens and data cross the network unencrypted: give --certs, or a reverse proxy that speaks TLS.")
    return notes


def check_traffic(config: ServiceConfig) -> list[str]:
    """Return what the user should know about the traffic of Dask.

    Raises
    ------
    InputError
        Where tokens keep others out, and the cluster would let them in.
    """
    cluster = config.cluster
    if cluster.resolved_kind == "local" or cluster.tls is not None:
        return []
    if config.needs_tokens:
        raise InputError(
            "tokens would not protect the service: everyone who reaches this cluster can run code on it",
            f"cluster of kind {cluster.resolved_kind}",
            "a cluster with TLS",
            "one without",
            "Make certificates with tract-dask certs DIR, start the cluster with them, and give them with --tls DIR",
        )
    if host_name(urlsplit(cluster.scheduler or "").netloc) in LOOPBACK:
        return []
    return [
        "Dask's traffic is not encrypted, and everyone who reaches the scheduler can run code on it: "
        "make certificates with tract-dask certs, and give them with --tls."
    ]


def check_state(config: ServiceConfig) -> list[str]:
    """Return what the user should know about the folder of what the service keeps."""
    old = config.data_root / STATE_FOLDER
    if config.state.is_relative_to(config.data_root):
        outside = state_folder(config.data_root, known=False)
        return [
            f"Jobs and tokens lie inside of the data root, in {config.state}. Stop the service, and move them out: "
            f"mkdir -p {outside.parent} && mv {config.state} {outside}"
        ]
    return [f"{old} of an earlier version is not used any more: delete it."] if (old / DATABASE).is_file() else []


def _named(config: ServiceConfig) -> str:
    """Return the options of tract-dask token that name this service's store."""
    usual = config.state == state_folder(config.data_root)
    return f"--data-root {config.data_root}" + ("" if usual else f" --state-dir {config.state}")


def create_token(config: ServiceConfig, name: str, role: str, file: Path | None = None) -> str:
    """Make a token in the store of a service; with ``file``, write it there for its owner's eyes only.

    Raises
    ------
    DestinationError
        Where the file is there already or cannot be written; no token is made then.
    InputError
        As :meth:`tract_dask.service.auth.tokens.Access.create_token`.
    """
    access = open_access(config)
    if file is None:
        return access.create_token(name, role)
    try:
        descriptor = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    except OSError as error:
        raise DestinationError(
            "the token cannot be written here",
            str(file),
            "a file that is not there yet",
            error.strerror or "",
            "Name another",
        ) from error
    with os.fdopen(descriptor, "w", encoding="utf-8") as written:
        try:
            made = access.create_token(name, role)
        except InputError:
            file.unlink()
            raise
        written.write(f"{made}\n")
    return made


def list_tokens(config: ServiceConfig) -> list[Token]:
    """Return all tokens of a service."""
    return open_access(config).tokens()


def revoke_token(config: ServiceConfig, name: str) -> Token:
    """Revoke a token of a service by name or ID; see :meth:`tract_dask.service.auth.tokens.Access.revoke`."""
    return open_access(config).revoke(name)


def tokens_in_use(config: ServiceConfig) -> list[Token]:
    """Return the tokens of a service that are not revoked."""
    return [token for token in open_access(config).tokens() if token.revoked is None]


def open_access(config: ServiceConfig) -> Access:
    """Return the tokens of a service, whether it runs or not."""
    config = settled(config)
    prepare_state(config)
    return Access(JobStore(config.database), config)


def banner(config: ServiceConfig, notes: list[str]) -> list[str]:
    """Return what the user reads when the service starts."""
    scheme = "https" if config.certificates else "http"
    host = socket.getfqdn() if config.host in ("0.0.0.0", "::") else config.host
    name = f"[{host}]" if ":" in host else host
    rows = {
        "open": f"{scheme}://{name}:{config.port}",
        "data root": str(config.data_root),
        "state": str(config.state),
        "cluster": describe_cluster(config),
        "jobs at once": str(config.concurrency),
        "access": "with a token" if config.needs_tokens else "everyone on this machine",
    }
    width = max(map(len, rows)) + 2
    lines = ["", "  tract_dask", "", *(f"  {name:<{width}}{value}" for name, value in rows.items()), ""]
    return [*lines, *(f"  Note: {note}" for note in notes), *([""] if notes else []), "  Stop with Ctrl-C."]


def describe_cluster(config: ServiceConfig) -> str:
    """Return where jobs run, in a few words."""
    cluster = config.cluster
    count = "one worker" if cluster.workers == 1 else f"{cluster.workers} workers"
    workers = count if cluster.workers else "one worker a core"
    encrypted = ", encrypted" if cluster.tls else ""
    kinds = {
        "local": f"this machine, {workers}",
        "address": f"{cluster.scheduler or cluster.scheduler_file}{encrypted}",
        "slurm": f"SLURM, {workers}{encrypted}",
        "ssh": f"{len(cluster.ssh.hosts)} machines by ssh, {workers} on each{encrypted}",
    }
    return kinds[cluster.resolved_kind]


def _settings(config: ServiceConfig, app: object) -> uvicorn.Config:
    """Return how uvicorn runs: silent but for what is wrong, and with a limit to how long it takes to stop."""
    certificate = config.certificates / SERVICE if config.certificates else None
    key = config.certificates / SERVICE_KEY if config.certificates else None
    return uvicorn.Config(
        app,  # type: ignore[arg-type]
        log_config=None,
        access_log=False,
        server_header=False,
        proxy_headers=bool(config.trusted_proxy),
        forwarded_allow_ips=config.trusted_proxy or None,
        timeout_graceful_shutdown=SHUTDOWN_S,
        ssl_certfile=certificate,
        ssl_keyfile=key,
        lifespan="on",
    )
