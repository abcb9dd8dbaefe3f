"""The credentials of a rack on the network: a folder with the authority, its own certificate and
key, and the secret.

authority.pem    certificates of the authority that signs every rack of this network RACK.pem
certificate of this rack: its common name is the rack's name, its alternative names are addresses
RACK-key.pem     private key of that certificate, for its owner's eyes only secret           32
bytes, or 64 hexadecimal digits: the key of the seals, the same on every machine of this network
"""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import suppress
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from cryptography.x509 import Certificate

SECRET_BYTES = 32
AUTHORITY = "authority.pem"
SECRET = "secret"
MAX_CREDENTIAL_BYTES = 100_000
OTHERS = stat.S_IRWXG | stat.S_IRWXO
OWNER_ONLY = 0o600


class Credential(Exception):
    """A file that cannot be used: its path, and why."""

    def __init__(self, path: Path, why: str) -> None:
        super().__init__(f"{path}: {why}")
        self.path = path
        self.why = why


class Credentials:
    """The files of one rack in a folder."""

    def __init__(self, folder: Path, rack: str) -> None:
        self.rack = rack
        self.authority = folder / AUTHORITY
        self.secret_file = folder / SECRET
        self.certificate = folder / f"{rack}.pem"
        self.key = folder / f"{rack}-key.pem"

    @cached_property
    def secret(self) -> bytes:
        """The key of the seals. Raises `Credential`."""
        content = _content(self.secret_file, is_private=True)
        if len(content) == SECRET_BYTES:
            return content
        with suppress(ValueError):
            if len(found := bytes.fromhex(content.decode("ascii").strip())) == SECRET_BYTES:
                return found
        raise Credential(
            self.secret_file,
            f"no secret; permitted: {SECRET_BYTES} bytes, or {2 * SECRET_BYTES} digits",
        )

    @property
    def expires(self) -> datetime:
        """When the first of the certificates expires. Raises `Credential`."""
        return min(
            one.not_valid_after_utc
            for path in (self.authority, self.certificate)
            for one in _certificates(path)
        )

    def flaws(self, addresses: Iterable[str] = ()) -> Iterator[Credential]:
        """Yield what is wrong with each file, now. `addresses` are those at which others reach this
        rack."""
        found: dict[Path, list[Certificate]] = {self.authority: [], self.certificate: []}
        for path in found:
            try:
                found[path] = _certificates(path)
            except Credential as flaw:
                yield flaw
        chain = found[self.certificate]
        if chain:
            yield from self._flaws_of(chain, found[self.authority], addresses)
        try:
            key = _public_part(self.key)
            if chain and key != chain[0].public_key():
                yield Credential(self.key, f"not the key of {self.certificate.name}")
        except Credential as flaw:
            yield flaw
        try:
            _ = self.secret
        except Credential as flaw:
            yield flaw

    def _flaws_of(
        self, chain: list[Certificate], authorities: list[Certificate], addresses: Iterable[str]
    ) -> Iterator[Credential]:
        if (name := _common_name(chain[0])) != self.rack:
            yield Credential(self.certificate, f"for '{name}', not for rack '{self.rack}'")
        if authorities and not _is_issued(chain, authorities):
            yield Credential(self.certificate, f"not signed by {self.authority.name}")
        if lost := [
            address for address in addresses if address not in (known := _addresses(chain[0]))
        ]:
            yield Credential(
                self.certificate,
                f"not for address {', '.join(lost)}; for {', '.join(known) or 'none'}",
            )


def _content(path: Path, is_private: bool = False) -> bytes:
    try:
        with path.open("rb") as file:
            about = os.fstat(file.fileno())
            if is_private and about.st_mode & OTHERS:
                mode = stat.S_IMODE(about.st_mode)
                raise Credential(
                    path, f"others may read it, mode {mode:04o}; permitted: {OWNER_ONLY:04o}"
                )
            if about.st_size > MAX_CREDENTIAL_BYTES:
                raise Credential(path, f"{about.st_size} bytes; permitted: {MAX_CREDENTIAL_BYTES}")
            return file.read(MAX_CREDENTIAL_BYTES)
    except FileNotFoundError:
        raise Credential(path, "missing; see rack lan certificates --help") from None
    except OSError as error:
        raise Credential(path, f"cannot be read: {error.strerror}") from None


def _certificates(path: Path) -> list[Certificate]:
    """Return the certificates of a PEM file that are valid now. Raises `Credential`."""
    content = _content(path)
    # Here: a rack without TLS does without this package.
    try:
        from cryptography.x509 import load_pem_x509_certificates
    except ImportError:
        raise Credential(
            path, "cannot be checked without 'cryptography': install nasrem-rack[lan]"
        ) from None
    try:
        found = load_pem_x509_certificates(content)
    except ValueError:
        raise Credential(path, "no certificate in PEM form") from None
    now = datetime.now(UTC)
    for certificate in found:
        if now > certificate.not_valid_after_utc:
            raise Credential(
                path, f"expired on {certificate.not_valid_after_utc:%Y-%m-%d %H:%M} UTC"
            )
        if now < certificate.not_valid_before_utc:
            raise Credential(
                path, f"not valid before {certificate.not_valid_before_utc:%Y-%m-%d %H:%M} UTC"
            )
    return found


def _public_part(path: Path) -> object:
    content = _content(path, is_private=True)
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    try:
        return load_pem_private_key(content, None).public_key()
    except TypeError:
        raise Credential(path, "encrypted; permitted: a key without a password") from None
    except (ValueError, UnsupportedAlgorithm):
        raise Credential(path, "no private key in PEM form") from None


def _common_name(certificate: Certificate) -> str:
    from cryptography.x509.oid import NameOID

    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def _addresses(certificate: Certificate) -> list[str]:
    from cryptography.x509 import DNSName, ExtensionNotFound, IPAddress, SubjectAlternativeName

    try:
        found = certificate.extensions.get_extension_for_class(SubjectAlternativeName).value
    except (ExtensionNotFound, ValueError):
        return []
    return [*map(str, found.get_values_for_type(IPAddress)), *found.get_values_for_type(DNSName)]


def _is_issued(chain: list[Certificate], authorities: list[Certificate]) -> bool:
    """Say whether each certificate of a chain is signed by the next, and one of them by an
    authority."""
    for at, certificate in enumerate(chain):
        if any(_issued(certificate, authority) for authority in authorities):
            return True
        if at + 1 == len(chain) or not _issued(certificate, chain[at + 1]):
            return False
    return False


def _issued(certificate: Certificate, issuer: Certificate) -> bool:
    from cryptography.exceptions import InvalidSignature

    try:
        certificate.verify_directly_issued_by(issuer)
    except (InvalidSignature, ValueError, TypeError):
        return False
    return True
