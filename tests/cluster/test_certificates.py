"""Certificates: what is in them, what they are good for, and what a second call leaves alone."""

import ipaddress
import json
import ssl
from contextlib import suppress
from datetime import UTC, datetime, timedelta

import pytest
from click.testing import CliRunner
from cryptography import x509
from cryptography.hazmat.primitives.serialization import load_pem_private_key
from cryptography.x509.oid import ExtendedKeyUsageOID

from tract_dask.cli.main import main
from tract_dask.cluster.certificates import (
    CA,
    CA_KEY,
    DASK,
    DASK_KEY,
    SERVICE,
    SERVICE_KEY,
    check_certificates,
    make_certificates,
)
from tract_dask.errors import DestinationError, InputError

HOSTS = ("tract.example.org", "10.0.0.5", "FD00::1")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("made") / "certificates"
    make_certificates(folder, HOSTS, days=100)
    return folder


def read(path):
    return x509.load_pem_x509_certificate(path.read_bytes())


def extension(certificate, kind):
    return certificate.extensions.get_extension_for_class(kind)


def talk(server, client, name):
    """A TLS handshake without a network; returns the name of the client's certificate, if it showed one."""
    to_server, to_client = ssl.MemoryBIO(), ssl.MemoryBIO()
    ends = (
        client.wrap_bio(to_client, to_server, server_hostname=name),
        server.wrap_bio(to_server, to_client, server_side=True),
    )
    for _ in range(4):
        for end in ends:
            try:
                end.do_handshake()
            except ssl.SSLWantReadError:
                continue
    with suppress(ssl.SSLWantReadError):
        ends[1].read()  # with TLS 1.3 the server refuses a client only after the client is done
    shown = ends[1].getpeercert()
    return dict(part[0] for part in shown["subject"])["commonName"] if shown else None


def server_of(folder, name, *, asks=False):
    context = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH, cafile=folder / CA)
    context.load_cert_chain(folder / name, folder / f"{name.removesuffix('.pem')}-key.pem")
    context.verify_mode = ssl.CERT_REQUIRED if asks else ssl.CERT_NONE
    return context


def client_of(folder, name=None):
    context = ssl.create_default_context(cafile=folder / CA)
    if name:
        context.load_cert_chain(folder / name, folder / f"{name.removesuffix('.pem')}-key.pem")
    return context


def test_each_says_what_it_is_for(folder):
    authority = read(folder / CA)
    assert extension(authority, x509.BasicConstraints).critical
    assert extension(authority, x509.BasicConstraints).value == x509.BasicConstraints(ca=True, path_length=0)
    assert extension(authority, x509.KeyUsage).value.key_cert_sign
    server, client = ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH
    for name, purposes in ((SERVICE, [server]), (DASK, [server, client])):
        found = read(folder / name)
        found.verify_directly_issued_by(authority)
        assert extension(found, x509.BasicConstraints).value.ca is False
        usage = extension(found, x509.KeyUsage)
        assert (usage.critical, usage.value.digital_signature, usage.value.key_cert_sign) == (True, True, False)
        assert list(extension(found, x509.ExtendedKeyUsage).value) == purposes
        names = extension(found, x509.SubjectAlternativeName).value
        assert names.get_values_for_type(x509.DNSName) == ["localhost", "tract.example.org"]
        addresses = ["127.0.0.1", "::1", "10.0.0.5", "fd00::1"]
        assert names.get_values_for_type(x509.IPAddress) == [ipaddress.ip_address(text) for text in addresses]
        assert timedelta(days=99) < found.not_valid_after_utc - datetime.now(UTC) < timedelta(days=100)
        key = load_pem_private_key((folder / f"{name.removesuffix('.pem')}-key.pem").read_bytes(), None)
        assert key.public_key() == found.public_key()


def test_keys_are_for_their_owner_only(folder):
    modes = {
        name: (folder / name).stat().st_mode & 0o777 for name in (CA_KEY, SERVICE_KEY, DASK_KEY, CA, SERVICE, DASK)
    }
    assert modes == {CA_KEY: 0o600, SERVICE_KEY: 0o600, DASK_KEY: 0o600, CA: 0o644, SERVICE: 0o644, DASK: 0o644}
    assert folder.stat().st_mode & 0o777 == 0o700
    assert {path.name for path in folder.iterdir()} == set(modes)


def test_they_are_taken_where_they_should_be_and_nowhere_else(folder, tmp_path):
    for name in ("localhost", "127.0.0.1", "tract.example.org", "10.0.0.5"):
        assert talk(server_of(folder, SERVICE), client_of(folder), name) is None
    with pytest.raises(ssl.SSLCertVerificationError, match="mismatch"):
        talk(server_of(folder, SERVICE), client_of(folder), "other.example.org")
    assert talk(server_of(folder, DASK, asks=True), client_of(folder, DASK), "localhost") == "tract_dask dask"
    for client in (client_of(folder), client_of(folder, SERVICE)):  # none, and one that is for servers
        with pytest.raises(ssl.SSLError):
            talk(server_of(folder, DASK, asks=True), client, "localhost")
    make_certificates(tmp_path / "other")
    stranger = client_of(folder)
    stranger.load_cert_chain(tmp_path / "other" / DASK, tmp_path / "other" / DASK_KEY)
    with pytest.raises(ssl.SSLError):
        talk(server_of(folder, DASK, asks=True), stranger, "localhost")
    with pytest.raises(ssl.SSLCertVerificationError):
        talk(server_of(folder, SERVICE), client_of(tmp_path / "other"), "localhost")


def test_a_second_call_keeps_what_is_good_and_adds_what_is_missing(tmp_path):
    first = make_certificates(tmp_path, ["a.example.org"])
    assert [certificate.made for certificate in first] == [True] * 3
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    assert [certificate.made for certificate in make_certificates(tmp_path)] == [False] * 3
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == before
    more = make_certificates(tmp_path, ["b.example.org"])
    assert [certificate.made for certificate in more] == [False, True, True]
    assert {"a.example.org", "b.example.org", "localhost"} <= set(more[1].hosts)
    (tmp_path / DASK).unlink()
    assert [certificate.made for certificate in make_certificates(tmp_path)] == [False, False, True]
    assert (tmp_path / CA).read_bytes() == before[CA]
    assert (tmp_path / CA_KEY).read_bytes() == before[CA_KEY]


def test_what_has_expired_is_renewed_and_what_another_signed_replaced(tmp_path):
    make_certificates(tmp_path / "a", days=0)
    with pytest.raises(InputError, match="expired"):
        check_certificates(tmp_path / "a")
    renewed = make_certificates(tmp_path / "a")
    assert [certificate.made for certificate in renewed] == [False, True, True]
    assert 820 < check_certificates(tmp_path / "a").days_left <= 825
    make_certificates(tmp_path / "b")
    for name in (DASK, DASK_KEY):
        (tmp_path / "a" / name).write_bytes((tmp_path / "b" / name).read_bytes())
    assert [certificate.made for certificate in make_certificates(tmp_path / "a")] == [False, False, True]
    client_of(tmp_path / "a", DASK)


def test_what_cannot_be_used_is_said(tmp_path):
    make_certificates(tmp_path)
    for host in ("a b", "", "http://x", "x" * 64, "a..b", "ü.example"):
        with pytest.raises(InputError, match="neither a host's name"):
            make_certificates(tmp_path, [host])
    (tmp_path / "pair").mkdir()
    for name in (CA, SERVICE):
        (tmp_path / "pair" / name).write_bytes((tmp_path / name).read_bytes())
    (tmp_path / "pair" / SERVICE_KEY).write_bytes((tmp_path / DASK_KEY).read_bytes())
    with pytest.raises(InputError, match="not a pair"):
        check_certificates(tmp_path / "pair")
    with pytest.raises(DestinationError, match="authority is incomplete"):
        make_certificates(tmp_path / "pair")
    (tmp_path / "pair" / SERVICE).write_text("no certificate")
    with pytest.raises(InputError, match="not a certificate"):
        check_certificates(tmp_path / "pair")
    with pytest.raises(InputError, match="cannot be read"):
        check_certificates(tmp_path / "none")
    (tmp_path / "file").write_text("")
    with pytest.raises(DestinationError, match="cannot be written"):
        make_certificates(tmp_path / "file" / "folder")


def test_the_commands(tmp_path):
    def run(*arguments):
        found = CliRunner().invoke(main, [*map(str, arguments)])
        return found.exit_code, found.output

    code, text = run("certs", tmp_path / "c", "--host", "h.example.org", "--days", 30)
    assert (code, text.count("made, until"), text.count("h.example.org")) == (0, 3, 2)
    code, text = run("certs", tmp_path / "c", "--json")
    assert [row["made"] for row in json.loads(text)] == [False] * 3
    root = ("--data-root", tmp_path)
    code, text = run("token", "create", "ann", "--json", *root)
    token = json.loads(text)["token"]
    assert run("token", "create", "ann", *root)[0] == 2
    assert run("token", "create", "probe", "--role", "monitor", "--file", tmp_path / "t", *root)[0] == 0
    code, text = run("token", "list", *root)
    assert ("ann" in text, "probe" in text, token in text) == (True, True, False)
    assert run("token", "revoke", "ann", *root)[0] == 0
    assert [row["revoked"] is None for row in json.loads(run("token", "list", "--json", *root)[1])] == [False, True]
    assert run("serve", "--data-root", tmp_path / "none")[0] == 2
