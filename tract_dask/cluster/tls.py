"""Encrypted traffic between scheduler, workers and clients: certificates as Dask takes them, of a folder or in memory.

A cluster that this machine holds for itself has credentials of its own, which exist in memory only and end with it:
other users of the machine reach its ports, and cannot say a word to what listens there.
"""

from __future__ import annotations

import ssl
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeAlias

import dask
from distributed.security import Security

from ..errors import ClusterError

Credentials: TypeAlias = dict[str, str]
"""Of one cluster: ``certificate`` and ``key``, PEM. Whoever has them can run code there."""

_DASK_TLS = "distributed.comm.tls"


def temporary_credentials() -> Credentials:
    """Return new credentials, in memory."""
    from .certificates import temporary_pair  # takes its time to import

    certificate, key = temporary_pair()
    return {"certificate": certificate, "key": key}


def in_memory(credentials: Credentials) -> Security:
    """Return what Dask needs to take part in the cluster that has these credentials, and in no other."""
    certificate, key = credentials["certificate"], credentials["key"]
    return _shared(certificate, certificate, key)


@contextmanager
def using(credentials: Credentials | None) -> Iterator[None]:
    """Let clients that are made in this block, with no folder of certificates, use these credentials."""
    if credentials is None:
        yield
        return
    certificate, key = credentials["certificate"], credentials["key"]
    with dask.config.set(
        {
            "distributed.comm.require-encryption": True,
            f"{_DASK_TLS}.ca-file": certificate,
            f"{_DASK_TLS}.client.cert": certificate,
            f"{_DASK_TLS}.client.key": key,
        }
    ):
        yield


def security(folder: str | None) -> Security | None:
    """Return what Dask needs to encrypt with the certificates in ``folder``, or None; see :mod:`.certificates`.

    Both ends of every connection have to show a certificate that ``ca.pem`` has signed; nothing unencrypted is spoken.

    Raises
    ------
    ClusterError
        Where a file of the folder is missing or cannot be read.
    """
    if folder is None:
        return None
    from .certificates import CA, DASK, DASK_KEY  # takes its time to import

    files = [Path(folder).absolute() / name for name in (CA, DASK, DASK_KEY)]
    for file in files:
        try:
            file.read_bytes()
        except OSError as error:
            raise ClusterError(
                "a certificate is missing",
                "setting tls (ClusterSettings)",
                f"{CA}, {DASK} and {DASK_KEY} in {folder}",
                str(error),
                f"Make them with: tract-dask certs {folder}",
            ) from error
    return _shared(*map(str, files))


def _shared(authority: str, certificate: str, key: str) -> Security:
    """Return a security in which scheduler, workers and clients use one certificate; of files, or PEM."""
    return Security(
        require_encryption=True,
        tls_ca_file=authority,
        **{f"tls_{role}_cert": certificate for role in ("client", "scheduler", "worker")},
        **{f"tls_{role}_key": key for role in ("client", "scheduler", "worker")},
    )


def web_context(folder: str | None) -> ssl.SSLContext | None:
    """Return how to check the certificate of a dashboard that uses those in ``folder``; None without a folder."""
    if folder is None:
        return None
    from .certificates import CA

    return ssl.create_default_context(cafile=Path(folder) / CA)


def worker_flags(used: Security | None) -> list[str]:
    """Return the options of ``dask worker`` with which a worker belongs to a cluster that uses this security."""
    if used is None or not used.require_encryption:
        return []
    found = used.get_tls_config_for_role("worker")
    if "\n" in str(found["key"]):  # in memory: nobody can start a worker by hand
        return []
    return [part for name in ("ca_file", "cert", "key") for part in (f"--tls-{name.replace('_', '-')}", found[name])]


def checked_address(address: str, folder: str | None) -> str:
    """Return a scheduler's address with its protocol, after a look whether that fits the certificates.

    Raises
    ------
    ClusterError
        Where the address says that traffic is encrypted and there are no certificates, or the other way round.

    Examples
    --------
    >>> checked_address("node1:8786", None), checked_address("node1:8786", "certificates")
    ('tcp://node1:8786', 'tls://node1:8786')
    """
    protocol, separator, rest = address.rpartition("://")
    if not separator:
        return f"{'tls' if folder else 'tcp'}://{rest}"
    if protocol == "tls" and folder is None and not dask.config.get(f"{_DASK_TLS}.ca-file"):
        raise ClusterError(
            "the scheduler speaks TLS and no certificates are given",
            address,
            "a folder of certificates (--tls)",
            "none",
            "Give the folder with which the scheduler was started",
        )
    if protocol == "tcp" and folder is not None:
        raise ClusterError(
            "certificates are given and the scheduler's traffic is not encrypted",
            address,
            "an address that begins with tls://",
            f"{protocol}:// with the certificates in {folder}",
            "Start scheduler and workers with the certificates (docs/deploy.md), or leave them out",
        )
    return address


def open_to_others(address: str) -> str:
    """Return a warning where a scheduler takes what everybody sends it; empty where it demands certificates.

    Examples
    --------
    >>> open_to_others("tls://10.0.0.1:8786")
    ''
    """
    if not address.startswith("tcp://"):
        return ""
    return (
        f"everyone who reaches {address} can run code as you: this cluster speaks without TLS. Make certificates with "
        "tract-dask certs DIR, start scheduler and workers with them, and give them to the run with --tls DIR"
    )
