"""The credentials of a rack on the network: a folder with the authority, and with its own
certificate and key.

authority.pem    certificates of the authority that signs every rack of this network
RACK.pem         certificate of this rack, and those that lead from it to the authority: its common
                 name is the rack's name, its alternative names are addresses
RACK-key.pem     private key of that certificate, for its owner's eyes only: it proves the rack to
                 those who connect, and seals what it sends
"""

from __future__ import annotations

import stat
from collections.abc import Iterable, Iterator
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import NamedTuple, TypeGuard

from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.ec import (
    ECDSA,
    SECP256R1,
    EllipticCurvePrivateKey,
    EllipticCurvePublicKey,
)
from cryptography.hazmat.primitives.asymmetric.utils import Prehashed
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import Encoding, load_pem_private_key
from cryptography.x509 import (
    BasicConstraints,
    Certificate,
    DNSName,
    ExtensionNotFound,
    InvalidVersion,
    IPAddress,
    SubjectAlternativeName,
    load_der_x509_certificate,
    load_pem_x509_certificates,
)
from cryptography.x509.oid import NameOID
from cryptography.x509.verification import (
    Criticality,
    ExtensionPolicy,
    PolicyBuilder,
    Store,
    VerificationError,
)

from rack.backplane.regular_file import read_regular_file
from rack.boards.lan.config import MOST_CHAIN, Credential

AUTHORITY = "authority.pem"
MAX_CREDENTIAL_BYTES = 100_000
MOST_KNOWN = 1024
"""Certificates of others that are remembered."""
OTHERS = stat.S_IRWXG | stat.S_IRWXO
OWNER_ONLY = 0o600
MINUTE = "%Y-%m-%d %H:%M"
_ALGORITHM = ECDSA(Prehashed(SHA256()))


class KeyPair(NamedTuple):
    """A rack's certificates, as they travel with its seals, and its key."""

    chain: bytes
    key: EllipticCurvePrivateKey

    def sign(self, digest: bytes) -> bytes:
        """Return the signature of 32 bytes."""
        return self.key.sign(digest, _ALGORITHM)


class Identity(NamedTuple):
    """Whom certificates name, with the key that checks its signatures."""

    name: str
    key: EllipticCurvePublicKey
    expires: datetime

    def has_signed(self, digest: bytes, signature: bytes) -> bool:
        """Say whether it has made a signature of 32 bytes."""
        try:
            self.key.verify(signature, digest, _ALGORITHM)
        except InvalidSignature:
            return False
        return True


class Credentials:
    """The files of one rack in a folder."""

    def __init__(self, folder: Path, rack: str) -> None:
        self.rack = rack
        self.authority = folder / AUTHORITY
        self.certificate = folder / f"{rack}.pem"
        self.key = folder / f"{rack}-key.pem"
        self._known: dict[bytes, Identity] = {}

    @cached_property
    def pair(self) -> KeyPair:
        """What it seals with. Raises `Credential`."""
        chain = load_certificates(self.certificate)
        content = b"".join(one.public_bytes(Encoding.DER) for one in chain)
        if len(content) > MOST_CHAIN:
            raise Credential(self.certificate, f"{len(content)} bytes; permitted: {MOST_CHAIN}")
        key = load_private_key(self.key)
        if key.public_key() != chain[0].public_key():
            raise Credential(self.key, f"not the key of {self.certificate.name}")
        return KeyPair(content, key)

    def identity(self, chain: bytes) -> Identity | None:
        """Return whom certificates name that came with a seal; None: nobody whom the authority has
        signed, or not any more. Raises `Credential`: the authority cannot be read.
        """
        found = self._known.get(chain)
        if found is None:
            if (found := _identified(chain, self._authorities)) is None:
                return None
            if len(self._known) >= MOST_KNOWN:
                self._known.clear()
            self._known[chain] = found
        return found if datetime.now(UTC) < found.expires else None

    @cached_property
    def _authorities(self) -> list[Certificate]:
        return load_certificates(self.authority)

    @property
    def expires(self) -> datetime:
        """When the first of the certificates expires. Raises `Credential`."""
        return min(
            one.not_valid_after_utc
            for path in (self.authority, self.certificate)
            for one in load_certificates(path)
        )

    def flaws(self, addresses: Iterable[str] = ()) -> Iterator[Credential]:
        """Yield what is wrong with each file, now. `addresses` are those at which others reach this
        rack.
        """
        found: dict[Path, list[Certificate]] = {self.authority: [], self.certificate: []}
        for path in found:
            try:
                found[path] = load_certificates(path)
            except Credential as flaw:
                yield flaw
        authorities, chain = found.values()
        if chain:
            if (name := _common_name(chain[0])) != self.rack:
                yield Credential(self.certificate, f"for '{name}', not for rack '{self.rack}'")
            if authorities and not _path(chain, authorities):
                yield Credential(self.certificate, f"not signed by {self.authority.name}")
            known = _addresses(chain[0])
            if lost := [address for address in addresses if address not in known]:
                permitted = ", ".join(known) or "none"
                why = f"not for address {', '.join(lost)}; for {permitted}"
                yield Credential(self.certificate, why)
        try:
            _ = self.pair if chain else load_private_key(self.key)
        except Credential as flaw:
            yield flaw


def _content(path: Path, is_private: bool = False) -> bytes:
    try:
        if is_private and (mode := stat.S_IMODE(path.stat().st_mode)) & OTHERS:
            raise Credential(
                path, f"others may read it, mode {mode:04o}; permitted: {OWNER_ONLY:04o}"
            )
        return read_regular_file(path, MAX_CREDENTIAL_BYTES)
    except FileNotFoundError:
        raise Credential(path, "missing; see rack lan certificates --help") from None
    except OSError as error:
        raise Credential(path, f"cannot be read: {error.strerror}") from None


def load_certificates(path: Path) -> list[Certificate]:
    """Return the certificates of a PEM file that are valid now. Raises `Credential`."""
    content = _content(path)
    try:
        found = load_pem_x509_certificates(content)
    except (ValueError, InvalidVersion):
        raise Credential(path, "no certificate in PEM form") from None
    now = datetime.now(UTC)
    for certificate in found:
        first, last = certificate.not_valid_before_utc, certificate.not_valid_after_utc
        if not first <= now <= last:
            why = (
                f"not valid before {first:{MINUTE}}"
                if now < first
                else f"expired on {last:{MINUTE}}"
            )
            raise Credential(path, f"{why} UTC")
    return found


def load_private_key(path: Path) -> EllipticCurvePrivateKey:
    """Return the key of a PEM file. Raises `Credential`."""
    content = _content(path, is_private=True)
    try:
        key = load_pem_private_key(content, None)
    except TypeError:
        raise Credential(path, "encrypted; permitted: a key without a password") from None
    except (ValueError, UnsupportedAlgorithm):
        raise Credential(path, "no private key in PEM form") from None
    if not isinstance(key, EllipticCurvePrivateKey) or not _is_p256(key.public_key()):
        raise Credential(path, "of another kind; permitted: a key on the curve P-256")
    return key


def _is_p256(key: object) -> TypeGuard[EllipticCurvePublicKey]:
    """Say whether a key is on the curve whose signatures are short and quick to check."""
    return isinstance(key, EllipticCurvePublicKey) and isinstance(key.curve, SECP256R1)


def _identified(chain: bytes, authorities: list[Certificate]) -> Identity | None:
    """Return whom certificates in DER form name; None: they do not lead to an authority."""
    found = []
    try:
        while chain:
            # Each says its length itself, in two bytes after the first two.
            size = 4 + int.from_bytes(chain[2:4], "big")
            found.append(load_der_x509_certificate(chain[:size]))
            chain = chain[size:]
        path = _path(found, authorities)
        name = _common_name(found[0])
        key = found[0].public_key()
    except Exception:
        # A stranger's bytes, and what they raise is not all documented: some are no `ValueError`.
        return None
    if not path or not _is_p256(key):
        return None
    return Identity(name, key, min(one.not_valid_after_utc for one in path))


def _common_name(certificate: Certificate) -> str:
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def _addresses(certificate: Certificate) -> list[str]:
    try:
        found = certificate.extensions.get_extension_for_class(SubjectAlternativeName).value
    except (ExtensionNotFound, ValueError):
        return []
    return [*map(str, found.get_values_for_type(IPAddress)), *found.get_values_for_type(DNSName)]


def _path(chain: list[Certificate], authorities: list[Certificate]) -> list[Certificate]:
    """Return the certificates from the first of a chain to an authority; empty: it does not lead
    there, as where the certificate of a rack has signed another one.
    """
    # As TLS does: of an authority that it says to be one, of a rack or person no more than that.
    any_kind = ExtensionPolicy.permit_all()
    authority = any_kind.require_present(BasicConstraints, Criticality.AGNOSTIC, None)
    policy = PolicyBuilder().store(Store(authorities))
    policy = policy.extension_policies(ca_policy=authority, ee_policy=any_kind)
    try:
        return policy.build_client_verifier().verify(chain[0], chain[1:]).chain
    except VerificationError:
        return []
