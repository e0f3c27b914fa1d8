"""Certificates of one's own for the service and for Dask: an authority, and what it signs.

The authority signs a certificate for the web service, and one that scheduler, workers and clients of Dask share: each
shows it to the others, and takes none that this authority has not signed for such use; the web service's is not.
Keys are elliptic (P-256), unencrypted, and readable by their owner only.
"""

from __future__ import annotations

import ipaddress
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from ..errors import DestinationError, InputError
from ..store import disk

CA, CA_KEY = "ca.pem", "ca-key.pem"
SERVICE, SERVICE_KEY = "service.pem", "service-key.pem"
DASK, DASK_KEY = "dask.pem", "dask-key.pem"

LOCAL_HOSTS = ("localhost", "127.0.0.1", "::1")
"""Names that every certificate has."""

CA_DAYS = 3650
EXPIRES_SOON_DAYS = 30

_PURPOSES = {
    SERVICE: (ExtendedKeyUsageOID.SERVER_AUTH,),
    DASK: (ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH),
}
_CLOCK_SKEW = timedelta(hours=1)
"""Certificates hold from a little before now, for machines whose clocks are behind."""


@dataclass(frozen=True)
class Certificate:
    """A certificate in the folder.

    Attributes
    ----------
    path
        Of the certificate; its key is beside it.
    expires
        UTC.
    hosts
        The names and addresses that it is for; none for the authority.
    made
        Whether it was made just now.
    """

    path: Path
    expires: datetime
    hosts: tuple[str, ...]
    made: bool

    @property
    def days_left(self) -> int:
        """Whole days until it expires; negative afterwards."""
        return (self.expires - datetime.now(UTC)).days


def make_certificates(folder: Path, hosts: Sequence[str] = (), *, days: int = 825) -> list[Certificate]:
    """Make what is missing in ``folder``, and return what is there: authority, service, Dask.

    An authority that is there is kept, since others trust it already. A certificate that is there is kept too, unless
    it lacks one of ``hosts``, has expired, or was signed by another authority; then it is made anew, for its old names
    as well.

    Parameters
    ----------
    folder
        Made where it is missing.
    hosts
        Names and addresses under which the machines are reached, beside those of the loopback.
    days
        How long new certificates hold; the authority holds ten years, and no certificate outlives it.

    Raises
    ------
    DestinationError
        Where the folder cannot be written, or holds half an authority: a certificate without its key.
    InputError
        Where a file is no certificate, a host is no name, or the authority has expired.
    """
    wanted = tuple(dict.fromkeys((*LOCAL_HOSTS, *map(_host, hosts))))
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        authority = _authority(folder)
        return [authority, *(_signed(folder, name, wanted, days) for name in (SERVICE, DASK))]
    except OSError as error:
        raise DestinationError(
            "the certificates cannot be written",
            str(error.filename or folder),
            got=str(error),
            remedy="Choose another folder",
        ) from error


def temporary_pair(days: int = 365) -> tuple[str, str]:
    """Return a certificate that has signed itself, for one cluster, and its key, as PEM texts.

    Who trusts nothing else takes only connections of those who hold this key.
    """
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "tract_dask temporary")])
    now = datetime.now(UTC)
    made = (
        _builder(name, name, key.public_key(), now, now + timedelta(days=days))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("tract-dask-temporary")]), critical=False)
        .sign(key, hashes.SHA256())
    )
    return made.public_bytes(serialization.Encoding.PEM).decode(), _key_text(key).decode()


def check_certificates(folder: Path, name: str = SERVICE) -> Certificate:
    """Return the certificate ``name`` of a folder, once it and its key are found to be readable, in time, and a pair.

    Raises
    ------
    InputError
        Where they are not.
    """
    remedy = f"Make certificates with: tract-dask certs {folder}"
    for file in (folder / CA, folder / name, _key_path(folder / name)):
        try:
            file.read_bytes()
        except OSError as error:
            raise InputError("this file cannot be read", str(file), got=error.strerror or "", remedy=remedy) from error
    found, key = _read(folder / name), _read_key(_key_path(folder / name))
    if found.public_key() != key.public_key():
        raise InputError("certificate and key are not a pair", str(folder / name), remedy=f"Remove both. {remedy}")
    if found.not_valid_after_utc < datetime.now(UTC):
        raise InputError(
            "the certificate has expired",
            str(folder / name),
            got=f"{found.not_valid_after_utc:%Y-%m-%d}",
            remedy=remedy,
        )
    return _about(folder / name, found, made=False)


def _authority(folder: Path) -> Certificate:
    path = folder / CA
    there = path.exists(), (folder / CA_KEY).exists()
    if there == (True, True):
        found = _read(path)
        if found.not_valid_after_utc < datetime.now(UTC):
            raise InputError(
                "the authority has expired",
                str(path),
                got=f"{found.not_valid_after_utc:%Y-%m-%d}",
                remedy="Make a new one in another folder, and give it to all machines",
            )
        return _about(path, found, made=False)
    if any(there):
        raise DestinationError(
            "the authority is incomplete",
            str(folder),
            f"{CA} and {CA_KEY}",
            CA if there[0] else CA_KEY,
            "Run this where the authority was made, or in an empty folder",
        )
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "tract_dask authority")])
    now = datetime.now(UTC)
    made = (
        _builder(name, name, key.public_key(), now, now + timedelta(days=CA_DAYS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_key_usage(signs_certificates=True), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .sign(key, hashes.SHA256())
    )
    _write(path, made, key)
    return _about(path, made, made=True)


def _signed(folder: Path, name: str, hosts: tuple[str, ...], days: int) -> Certificate:
    path = folder / name
    authority, authority_key = _read(folder / CA), _read_key(folder / CA_KEY)
    if path.exists() and _key_path(path).exists():
        found = _read(path)
        had = _hosts(found)
        if found.not_valid_after_utc > datetime.now(UTC) and set(hosts) <= set(had) and _is_signed(found, authority):
            return _about(path, found, made=False)
        hosts = tuple(dict.fromkeys((*had, *hosts)))
    key = ec.generate_private_key(ec.SECP256R1())
    now = datetime.now(UTC)
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, f"tract_dask {name.removesuffix('.pem')}")])
    expires = min(now + timedelta(days=days), authority.not_valid_after_utc)
    identifier = authority.extensions.get_extension_for_class(x509.SubjectKeyIdentifier).value
    made = (
        _builder(subject, authority.subject, key.public_key(), now, expires)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_key_usage(signs_certificates=False), critical=True)
        .add_extension(x509.ExtendedKeyUsage(_PURPOSES[name]), critical=False)
        .add_extension(x509.SubjectAlternativeName(map(_general_name, hosts)), critical=False)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(identifier), critical=False)
        .sign(authority_key, hashes.SHA256())
    )
    _write(path, made, key)
    return _about(path, made, made=True)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, now: datetime, expires: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - _CLOCK_SKEW)
        .not_valid_after(expires)
    )


def _key_usage(*, signs_certificates: bool) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=not signs_certificates,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=signs_certificates,
        crl_sign=signs_certificates,
        encipher_only=False,
        decipher_only=False,
    )


def _is_signed(found: x509.Certificate, authority: x509.Certificate) -> bool:
    try:
        found.verify_directly_issued_by(authority)
    except Exception:  # noqa: BLE001  whatever is wrong with it, it is made anew
        return False
    return True


def _host(name: str) -> str:
    """Return a host's name or address in its usual form.

    Raises
    ------
    InputError
        Where it is neither.
    """
    try:
        return str(ipaddress.ip_address(name.strip("[]")))
    except ValueError:
        pass
    labels = name.removeprefix("*.").rstrip(".").split(".")
    if not all(0 < len(label) <= 63 and label.isascii() and label.replace("-", "").isalnum() for label in labels):
        raise InputError(
            "this is neither a host's name nor an address",
            name,
            "such as tract.example.org or 10.0.0.5",
            remedy="Correct it",
        )
    return name.lower()


def _general_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        return x509.DNSName(host)


def _hosts(found: x509.Certificate) -> tuple[str, ...]:
    try:
        names: Iterable[x509.GeneralName] = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return ()
    return tuple(str(name.value) for name in names)


def _about(path: Path, found: x509.Certificate, *, made: bool) -> Certificate:
    return Certificate(path, found.not_valid_after_utc, _hosts(found), made)


def _key_path(path: Path) -> Path:
    return path.with_name(f"{path.stem}-key.pem")


def _read(path: Path) -> x509.Certificate:
    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except ValueError as error:
        raise InputError(
            "this is not a certificate", str(path), "PEM", remedy="Remove it, and make a new one"
        ) from error


def _read_key(path: Path) -> ec.EllipticCurvePrivateKey:
    try:
        found = serialization.load_pem_private_key(path.read_bytes(), None)
    except (TypeError, ValueError) as error:
        raise InputError("this is not a key without a password", str(path), "PEM", remedy="Make a new one") from error
    if not isinstance(found, ec.EllipticCurvePrivateKey):
        raise InputError("this is not a key on an elliptic curve", str(path), remedy="Make a new one")
    return found


def _key_text(key: ec.EllipticCurvePrivateKey) -> bytes:
    plain = serialization.NoEncryption()
    return key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, plain)


def _write(path: Path, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
    """Write the key, then the certificate, each aside and then renamed; a key is never readable by others."""
    public = certificate.public_bytes(serialization.Encoding.PEM)
    for place, data, mode in ((_key_path(path), _key_text(key), 0o600), (path, public, 0o644)):
        aside = disk.aside(place, os.getpid())
        with os.fdopen(os.open(aside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(data)
        aside.replace(place)
