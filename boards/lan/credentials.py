"""Credentials of a rack on the network: a folder with the authority and the rack's key.

authority.pem   certificates of the authority that signs every rack of this network
RACK.pem        certificate of this rack and the ones that lead from it to the authority. Its
                common name is the rack's name; its alternative names are addresses.
RACK-key.pem    private key of that certificate, readable by its owner only. It proves the
                rack's identity to those who connect, and seals what the rack sends.
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
from rack.boards.lan.config import MAX_CHAIN_BYTES, CredentialError

AUTHORITY = "authority.pem"
MAX_CREDENTIAL_BYTES = 100_000
MAX_REMEMBERED = 1024
"""Maximum number of senders whose checked certificates are cached."""
OTHERS_MODE = stat.S_IRWXG | stat.S_IRWXO
OWNER_ONLY = 0o600
MINUTE = "%Y-%m-%d %H:%M"
_ALGORITHM = ECDSA(Prehashed(SHA256()))


class KeyPair(NamedTuple):
    """Certificates of a rack in DER form, as they are sent with its seals, and its private key."""

    chain: bytes
    key: EllipticCurvePrivateKey

    def sign_digest(self, digest: bytes) -> bytes:
        """Return the signature of a digest of 32 bytes."""
        return self.key.sign(digest, _ALGORITHM)


class Identity(NamedTuple):
    """Name and public key from a checked certificate, and the time of its expiry."""

    name: str
    key: EllipticCurvePublicKey
    expires: datetime

    def has_signed(self, digest: bytes, signature: bytes) -> bool:
        """Return True if the signature of the 32-byte digest was made with this identity's key."""
        try:
            self.key.verify(signature, digest, _ALGORITHM)
        except InvalidSignature:
            return False
        return True


class Credentials:
    """Credential files of one rack.

    Attributes:
        rack: Name of the rack.
        authority: Path of the authority's certificates.
        certificate: Path of the rack's certificate.
        key: Path of the rack's private key.
    """

    def __init__(self, folder: Path, rack: str) -> None:
        self.rack = rack
        self.authority = folder / AUTHORITY
        self.certificate = folder / f"{rack}.pem"
        self.key = folder / f"{rack}-key.pem"
        self._known: dict[bytes, Identity] = {}

    @cached_property
    def key_pair(self) -> KeyPair:
        """Certificates and private key with which the rack seals its messages.

        Raises:
            CredentialError: A file cannot be used, or the key does not match the certificate.
        """
        chain = load_certificates(self.certificate)
        content = b"".join(certificate.public_bytes(Encoding.DER) for certificate in chain)
        if len(content) > MAX_CHAIN_BYTES:
            raise CredentialError(
                self.certificate,
                f"the certificates have {len(content)} bytes; at most {MAX_CHAIN_BYTES} "
                "are allowed",
            )
        key = load_private_key(self.key)
        if key.public_key() != chain[0].public_key():
            raise CredentialError(self.key, f"the key does not belong to {self.certificate.name}")
        return KeyPair(content, key)

    def identify_sender(self, chain: bytes) -> Identity | None:
        """Verify the certificates that came with a seal and return the sender's identity.

        Args:
            chain: Certificates in DER form, the sender's first.

        Returns:
            The identity. None if the authority has not signed the certificates or if one of them
            has expired.

        Raises:
            CredentialError: The authority's certificates cannot be read.
        """
        identity = self._known.get(chain)
        if identity is None:
            if (identity := _identify_chain(chain, self._authority_certificates)) is None:
                return None
            if len(self._known) >= MAX_REMEMBERED:
                self._known.clear()
            self._known[chain] = identity
        return identity if datetime.now(UTC) < identity.expires else None

    @cached_property
    def _authority_certificates(self) -> list[Certificate]:
        """Certificates of the authority."""
        return load_certificates(self.authority)

    @property
    def expiry_time(self) -> datetime:
        """Earliest time at which one of the certificates expires. Raises `CredentialError`."""
        return min(
            certificate.not_valid_after_utc
            for path in (self.authority, self.certificate)
            for certificate in load_certificates(path)
        )

    def find_flaws(self, addresses: Iterable[str] = ()) -> Iterator[CredentialError]:
        """Yield an error for each mistake in the credential files.

        Args:
            addresses: Addresses at which others reach this rack. The certificate must contain all
                of them.
        """
        certificates: dict[Path, list[Certificate]] = {self.authority: [], self.certificate: []}
        for path in certificates:
            try:
                certificates[path] = load_certificates(path)
            except CredentialError as flaw:
                yield flaw
        authorities, chain = certificates.values()
        if chain:
            if (name := _read_common_name(chain[0])) != self.rack:
                yield CredentialError(
                    self.certificate,
                    f"the certificate is for '{name}' instead of rack '{self.rack}'",
                )
            if authorities and not _find_trust_path(chain, authorities):
                yield CredentialError(
                    self.certificate, f"the certificate is not signed by {self.authority.name}"
                )
            certified = _list_addresses(chain[0])
            if missing := [address for address in addresses if address not in certified]:
                why = f"the certificate is not valid for address {', '.join(missing)}"
                yield CredentialError(
                    self.certificate, f"{why}; valid addresses: {', '.join(certified) or 'none'}"
                )
        try:
            _ = self.key_pair if chain else load_private_key(self.key)
        except CredentialError as flaw:
            yield flaw


def _read_credential(path: Path, is_private: bool = False) -> bytes:
    """Return the content of a credential file. A private one must be readable by its owner only."""
    try:
        if is_private and (mode := stat.S_IMODE(path.stat().st_mode)) & OTHERS_MODE:
            raise CredentialError(
                path, f"mode {mode:04o} lets others read it; it must be {OWNER_ONLY:04o}"
            )
        return read_regular_file(path, MAX_CREDENTIAL_BYTES)
    except FileNotFoundError:
        raise CredentialError(
            path, "the file is missing; see rack lan certificates --help"
        ) from None
    except OSError as error:
        raise CredentialError(path, f"cannot be read: {error.strerror}") from None


def load_certificates(path: Path) -> list[Certificate]:
    """Return the certificates of a PEM file, all of which must be valid now.

    Raises:
        CredentialError: The file cannot be read, or a certificate is malformed, expired or not yet
            valid.
    """
    content = _read_credential(path)
    try:
        certificates = load_pem_x509_certificates(content)
    except (ValueError, InvalidVersion):
        raise CredentialError(path, "the file contains no certificate in PEM form") from None
    now_utc = datetime.now(UTC)
    for certificate in certificates:
        first, last = certificate.not_valid_before_utc, certificate.not_valid_after_utc
        if not first <= now_utc <= last:
            why = (
                f"the certificate is not valid before {first:{MINUTE}}"
                if now_utc < first
                else f"the certificate expired on {last:{MINUTE}}"
            )
            raise CredentialError(path, f"{why} UTC")
    return certificates


def load_private_key(path: Path) -> EllipticCurvePrivateKey:
    """Return the private key of a PEM file. It must be unencrypted and on the curve P-256.

    Raises:
        CredentialError: The file cannot be read or its key cannot be used.
    """
    content = _read_credential(path, is_private=True)
    try:
        key = load_pem_private_key(content, None)
    except TypeError:
        raise CredentialError(path, "the key is encrypted; it must have no password") from None
    except (ValueError, UnsupportedAlgorithm):
        raise CredentialError(path, "the file contains no private key in PEM form") from None
    if not isinstance(key, EllipticCurvePrivateKey) or not _is_p256(key.public_key()):
        raise CredentialError(path, "the key is of another kind; it must be on the curve P-256")
    return key


def _is_p256(key: object) -> TypeGuard[EllipticCurvePublicKey]:
    """Return True if a public key is on P-256, whose signatures are short and quick to check."""
    return isinstance(key, EllipticCurvePublicKey) and isinstance(key.curve, SECP256R1)


def _identify_chain(chain: bytes, authorities: list[Certificate]) -> Identity | None:
    """Return the identity of the first certificate of a DER chain.

    The result is None if the chain is malformed or not signed by an authority, or if the key is not
    on P-256.
    """
    certificates = []
    try:
        while chain:
            # Bytes 2 and 3 of a DER certificate of this size contain its length.
            size = 4 + int.from_bytes(chain[2:4], "big")
            certificates.append(load_der_x509_certificate(chain[:size]))
            chain = chain[size:]
        trusted = _find_trust_path(certificates, authorities)
        name = _read_common_name(certificates[0])
        key = certificates[0].public_key()
    except Exception:
        # Anyone may have sent these bytes, and the parser may raise undocumented exceptions.
        return None
    if not trusted or not _is_p256(key):
        return None
    return Identity(name, key, min(certificate.not_valid_after_utc for certificate in trusted))


def _read_common_name(certificate: Certificate) -> str:
    """Return the common name of a certificate, or an empty string."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def _list_addresses(certificate: Certificate) -> list[str]:
    """Return the addresses and host names for which a certificate is valid."""
    try:
        alternatives = certificate.extensions.get_extension_for_class(SubjectAlternativeName).value
    except (ExtensionNotFound, ValueError):
        return []
    return [
        *map(str, alternatives.get_values_for_type(IPAddress)),
        *alternatives.get_values_for_type(DNSName),
    ]


def _find_trust_path(chain: list[Certificate], authorities: list[Certificate]) -> list[Certificate]:
    """Return the verified path from the first certificate of a chain up to an authority.

    Returns:
        The certificates of the path. Empty if the chain does not lead to an authority, for example
        if the certificate of one rack has signed the certificate of another.
    """
    # As in TLS, the certificate of an authority must be marked as such. The other certificates may
    # have any extensions.
    any_kind = ExtensionPolicy.permit_all()
    authority = any_kind.require_present(BasicConstraints, Criticality.AGNOSTIC, None)
    policy = PolicyBuilder().store(Store(authorities))
    policy = policy.extension_policies(ca_policy=authority, ee_policy=any_kind)
    try:
        return policy.build_client_verifier().verify(chain[0], chain[1:]).chain
    except VerificationError:
        return []
