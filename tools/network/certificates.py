"""Creation of credentials: an authority, and a certificate and key for each rack.

Keys are on the curve P-256, which every TLS library supports and which the seals require. A
certificate is valid for both sides of a connection, because racks both listen and connect.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from functools import partial
from ipaddress import ip_address
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat
from cryptography.x509.oid import NameOID

from rack.backplane.rack_name import RACK_NAME
from rack.boards.lan.config import CredentialError
from rack.boards.lan.credentials import (
    AUTHORITY,
    OWNER_ONLY,
    Credentials,
    load_certificates,
    load_private_key,
)
from rack.boards.lan.endpoint import Endpoint
from rack.tools.console.answer import Failure

AUTHORITY_KEY = "authority-key.pem"
AUTHORITY_NAME = "rack test authority"
CLOCK_MARGIN = timedelta(hours=1)
"""Certificates are valid from this long before now, because clocks of machines differ."""


@dataclass(frozen=True)
class CredentialFiles:
    """Contents of the created files, keyed by file name, and expiry time of the certificates."""

    files: Mapping[str, bytes]
    expires: datetime


class Authority(NamedTuple):
    """Certificate and private key of an authority."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def make_credentials(
    folder: Path, names: Mapping[str, Sequence[str]], days: int
) -> CredentialFiles:
    """Write a certificate and a key for each name. Create the authority if the folder has none.

    Args:
        folder: Folder for the files.
        names: Dictionary from the name of each rack or operator to its host names and addresses.
            The sequence is empty for one that only connects.
        days: Validity of the certificates in days, at most until the authority's certificate
            expires.

    Raises:
        Failure: A file exists already, or the authority in the folder cannot be used.
    """
    wanted = [Credentials(folder, name) for name in names]
    pairs = [path for rack in wanted for path in (rack.certificate, rack.key)]
    if taken := [path.name for path in pairs if os.path.lexists(path)]:
        raise Failure(f"{folder}: {', '.join(taken)} exist already; nothing is overwritten", 2)
    files: dict[str, bytes] = {}
    expires = datetime.now(UTC) + timedelta(days=days)
    if any(os.path.lexists(folder / name) for name in (AUTHORITY, AUTHORITY_KEY)):
        authority = _load_authority(folder)
    else:
        key = ec.generate_private_key(ec.SECP256R1())
        authority = Authority(sign_certificate(AUTHORITY_NAME, key, None, expires), key)
        files |= {AUTHORITY: to_pem(authority.certificate), AUTHORITY_KEY: key_to_pem(key)}
    expires = min(expires, authority.certificate.not_valid_after_utc)
    for rack, addresses in zip(wanted, names.values(), strict=True):
        key = ec.generate_private_key(ec.SECP256R1())
        certificate = sign_certificate(rack.rack, key, authority, expires, addresses)
        files |= {rack.certificate.name: to_pem(certificate), rack.key.name: key_to_pem(key)}
    write_credentials(folder, files)
    return CredentialFiles(files, expires)


def _load_authority(folder: Path) -> Authority:
    """Return the authority in a folder. Raises `Failure` if it cannot be used."""
    try:
        certificate, *_ = load_certificates(folder / AUTHORITY)
        key = load_private_key(folder / AUTHORITY_KEY)
    except CredentialError as flaw:
        raise Failure(str(flaw), 2) from None
    if key.public_key() != certificate.public_key():
        raise Failure(f"{folder}: {AUTHORITY_KEY} is not the key of {AUTHORITY}", 2)
    return Authority(certificate, key)


def sign_certificate(
    name: str,
    key: ec.EllipticCurvePrivateKey,
    authority: Authority | None,
    expires: datetime,
    addresses: Sequence[str] = (),
) -> x509.Certificate:
    """Create a certificate and sign it.

    Args:
        name: Common name of the certificate.
        key: Private key that belongs to it.
        authority: Authority that signs it. None for the certificate of a new authority, which signs
            itself.
        expires: End of its validity.
        addresses: Host names and addresses of a rack that listens.
    """
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    is_authority = authority is None
    issuer, signer = (subject, key) if authority is None else (authority[0].subject, authority.key)
    usage = x509.KeyUsage(
        digital_signature=not is_authority,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=is_authority,
        crl_sign=is_authority,
        encipher_only=False,
        decipher_only=False,
    )
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(min(datetime.now(UTC), expires) - CLOCK_MARGIN)
        .not_valid_after(expires)
        .add_extension(x509.BasicConstraints(is_authority, 0 if is_authority else None), True)
        .add_extension(usage, True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), False)
        .add_extension(
            x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.public_key()), False
        )
    )
    if addresses:
        names = x509.SubjectAlternativeName(map(_to_general_name, addresses))
        builder = builder.add_extension(names, False)
    return builder.sign(signer, hashes.SHA256())


def _to_general_name(text: str) -> x509.GeneralName:
    """Convert an address or a host name to a subject alternative name."""
    try:
        return x509.IPAddress(ip_address(text))
    except ValueError:
        return x509.DNSName(text)


def to_pem(certificate: x509.Certificate) -> bytes:
    """Return a certificate in PEM form."""
    return certificate.public_bytes(Encoding.PEM)


def key_to_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    """Return a private key in PEM form, without a password."""
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def write_credentials(folder: Path, files: Mapping[str, bytes]) -> None:
    """Write new files, which only the owner can read, and create the folder if necessary.

    Raises:
        FileExistsError: A file exists already.
    """
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    for name, content in files.items():
        # An existing file or link is never opened.
        with open(folder / name, "xb", opener=partial(os.open, mode=OWNER_ONLY)) as file:
            file.write(content)


def parse_named_addresses(entries: Iterable[str]) -> dict[str, list[str]]:
    """Parse the values of `--for`, such as "cell=10.0.0.1,cell.local" or "operator".

    Returns:
        A dictionary from each name to its addresses, which may be empty.

    Raises:
        Failure: A name or an address is malformed, or a name is repeated.
    """
    addresses_by_name: dict[str, list[str]] = {}
    for entry in entries:
        name, has_addresses, rest = entry.partition("=")
        addresses = rest.split(",") if has_addresses else []
        why = ""
        if re.fullmatch(RACK_NAME, name) is None:
            why = "a name consists of at most 40 of the characters a-z, 0-9, _ and -"
        elif name in addresses_by_name:
            why = f"{name} is named twice"
        elif name == "authority" or name.endswith("-key"):
            why = "a file of the set would have this name"
        try:
            for address in addresses:
                Endpoint.from_text(f"tls/{f'[{address}]' if ':' in address else address}:1")
        except ValueError:
            why = why or "it must be NAME or NAME=ADDRESS,... with host names or addresses"
        if why:
            raise Failure(f'--for = "{entry}": {why}', 2)
        addresses_by_name[name] = addresses
    return addresses_by_name
