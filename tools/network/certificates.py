"""Making of credentials: an authority, and a certificate and key for each rack.

The keys are on the curve P-256, which every TLS library knows, and which the seals need. A
certificate serves both sides of a connection: racks listen and connect.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    load_pem_private_key,
)
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from rack.boards.lan.credentials import AUTHORITY, OWNER_ONLY, Credentials
from rack.tools.console.answer import Failure

AUTHORITY_KEY = "authority-key.pem"
AUTHORITY_NAME = "rack test authority"
EARLIER = timedelta(hours=1)
"""A certificate is valid from this long ago: machines' clocks differ."""


@dataclass(frozen=True)
class Made:
    """What was made: files by name, and when the certificates expire."""

    files: Mapping[str, bytes]
    expires: datetime


class _Authority(NamedTuple):
    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def make_credentials(folder: Path, names: Mapping[str, Sequence[str]], days: int) -> Made:
    """Write a certificate and key for each name with its addresses; a new authority, if there
    is none.

    Raises `Failure`: a file is there already, the set there is not whole, or its authority has
    expired.
    """
    now = datetime.now(UTC)
    wanted = [Credentials(folder, name) for name in names]
    pairs = [path for own in wanted for path in (own.certificate, own.key)]
    if taken := [path.name for path in pairs if os.path.lexists(path)]:
        raise Failure(f"{folder}: {', '.join(taken)} exist already; nothing is overwritten", 2)
    shared = (AUTHORITY, AUTHORITY_KEY)
    there = [name for name in shared if os.path.lexists(folder / name)]
    if there and len(there) < len(shared):
        lost = ", ".join(name for name in shared if name not in there)
        raise Failure(
            f"{folder}: {lost} missing; a set is added to where its authority and its key are", 2
        )
    files: dict[str, bytes] = {}
    expires = now + timedelta(days=days)
    if there:
        authority = _found(folder, now)
    else:
        authority = _made(now, expires)
        files |= {AUTHORITY: _pem(authority.certificate), AUTHORITY_KEY: _key_pem(authority.key)}
    expires = min(expires, authority.certificate.not_valid_after_utc)
    for name, addresses in names.items():
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = _for_rack(name, addresses, key, authority, now, expires)
        own = Credentials(folder, name)
        files |= {own.certificate.name: _pem(certificate), own.key.name: _key_pem(key)}
    _write(folder, files)
    return Made(files, expires)


def _made(now: datetime, expires: datetime) -> _Authority:
    key = ec.generate_private_key(ec.SECP256R1())
    own = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
    name = _named(AUTHORITY_NAME)
    builder = _builder(name, key, name, now, expires, signs_certificates=True)
    builder = builder.add_extension(own, critical=False)
    return _Authority(builder.sign(key, hashes.SHA256()), key)


def _found(folder: Path, now: datetime) -> _Authority:
    """Return the authority of a set. Raises `Failure`."""
    try:
        certificate = x509.load_pem_x509_certificate((folder / AUTHORITY).read_bytes())
        key = load_pem_private_key((folder / AUTHORITY_KEY).read_bytes(), None)
    except (ValueError, TypeError):
        raise Failure(
            f"{folder}: {AUTHORITY} or {AUTHORITY_KEY} is not in PEM form, or has a password", 2
        ) from None
    if (
        not isinstance(key, ec.EllipticCurvePrivateKey)
        or key.public_key() != certificate.public_key()
    ):
        raise Failure(f"{folder}: {AUTHORITY_KEY} is not the key of {AUTHORITY}", 2)
    if certificate.not_valid_after_utc <= now:
        raise Failure(
            f"{folder}: {AUTHORITY} expired on {certificate.not_valid_after_utc:%Y-%m-%d}; make a"
            " new set",
            2,
        )
    return _Authority(certificate, key)


def _for_rack(
    name: str,
    addresses: Sequence[str],
    key: ec.EllipticCurvePrivateKey,
    authority: _Authority,
    now: datetime,
    expires: datetime,
) -> x509.Certificate:
    issuer = authority.certificate.subject
    builder = _builder(_named(name), key, issuer, now, expires, signs_certificates=False)
    both = x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH])
    signer = x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key())
    builder = builder.add_extension(both, critical=False).add_extension(signer, critical=False)
    if addresses:
        names = x509.SubjectAlternativeName(map(_address, addresses))
        builder = builder.add_extension(names, critical=False)
    return builder.sign(authority.key, hashes.SHA256())


def _builder(
    name: x509.Name,
    key: ec.EllipticCurvePrivateKey,
    issuer: x509.Name,
    now: datetime,
    expires: datetime,
    signs_certificates: bool,
) -> x509.CertificateBuilder:
    path_length = 0 if signs_certificates else None
    constraints = x509.BasicConstraints(ca=signs_certificates, path_length=path_length)
    usage = x509.KeyUsage(
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
    return (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - EARLIER)
        .not_valid_after(expires)
        .add_extension(constraints, critical=True)
        .add_extension(usage, critical=True)
    )


def _named(name: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _address(text: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(text))
    except ValueError:
        return x509.DNSName(text)


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(Encoding.PEM)


def _key_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def _write(folder: Path, files: Mapping[str, bytes]) -> None:
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    for name, content in files.items():
        # Its owner's from the first moment on, and never through a link that somebody left.
        fd = os.open(
            folder / name, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, OWNER_ONLY
        )
        with os.fdopen(fd, "wb") as file:
            file.write(content)


def named_addresses(entries: Iterable[str]) -> dict[str, list[str]]:
    """Return the addresses by name from texts as in cell=10.0.0.1,cell.local or operator. Raises
    `Failure`."""
    from pydantic import TypeAdapter, ValidationError

    from rack.boards.lan.config import PeerName
    from rack.boards.lan.endpoint import Endpoint

    proper_name = TypeAdapter(PeerName)
    found: dict[str, list[str]] = {}
    for entry in entries:
        name, has_addresses, rest = entry.partition("=")
        addresses = rest.split(",") if has_addresses else []
        try:
            proper_name.validate_python(name)
            for address in addresses:
                host = f"[{address}]" if ":" in address else address
                Endpoint.of(f"tls/{host}:1")
        except ValidationError:
            raise Failure(
                f'--for = "{entry}": permitted names: a-z, 0-9, _ and -, at most 40', 2
            ) from None
        except ValueError:
            raise Failure(
                f'--for = "{entry}": permitted: NAME, or NAME=ADDRESS,... with host names or'
                " addresses",
                2,
            ) from None
        if name in found:
            raise Failure(f'--for = "{entry}": {name} is named twice', 2)
        if name == "authority" or name.endswith("-key"):
            raise Failure(f'--for = "{entry}": a file of the set would have this name', 2)
        found[name] = addresses
    return found
