"""Envelope of a message on the network: its origin, its time and a seal.

The payload is the message as it is stored in its mailbox. Nothing is decoded before the seal is
checked. The seal is a signature over key expression, head and payload with the key of the sender's
certificate, which is sent along. A message therefore cannot be changed, presented as a message of
another mailbox, or made by another rack in the sender's name. Without certificates the seal is a
plain hash and detects damage only.

Alternatives considered: one secret for all racks (each could speak for any other), one secret for
each pair (a mailbox has many readers, so a message would need many seals), certificates of all
racks in each folder (all folders would change whenever one certificate is renewed).
"""

from __future__ import annotations

from enum import IntEnum
from hashlib import sha256
from hmac import compare_digest
from struct import Struct
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from xxhash import xxh3_64_intdigest as xxh3

from rack.boards.lan.config import MAX_CHAIN_BYTES
from rack.boards.lan.keys import parse_sender

if TYPE_CHECKING:
    from rack.boards.lan.credentials import Credentials

_HEAD = Struct("<4sIHQQQQqqqq")
_MAGIC = b"RLN3"
MAX_MESSAGE_BYTES = 65_536
"""Length of the longest message that is accepted, and of the longest step in lockstep."""
MAX_SEAL_BYTES = 72
"""Length of the longest seal in bytes."""
MAX_ENVELOPE_BYTES = _HEAD.size + MAX_CHAIN_BYTES + MAX_SEAL_BYTES


class Envelope(NamedTuple):
    """Head of a message on the network.

    Attributes:
        kind: Fingerprint of the message type: see `compute_kind`.
        launch: Random number of the launch that sent the message.
        serial: Serial of the message in its mailbox. Questions, answers and tokens count
            separately.
        number: Number of the message among those sent from its mailbox. Unlike `serial` it has no
            gaps.
        tick: Release of the cycle that wrote the message, on the sender's grid.
        time_ns: Simulated time of that tick.
        stamp_ns: CLOCK_MONOTONIC of that tick on the sender's machine. In lockstep, `time_ns`.
        flags: Meaning depends on the kind.
        age_ns: Time in ns from the tick of the oldest information in the message until `tick`.
    """

    kind: int
    launch: int
    serial: int
    number: int
    tick: int
    time_ns: int
    stamp_ns: int
    flags: int = 0
    age_ns: int = 0


class Flaw(IntEnum):
    """Reasons for which a received message is rejected unread."""

    MALFORMED = 1  # no head, or a head of another version
    UNSIGNED = 2  # the seal does not match
    OVERSIZED = 3  # longer than permitted


def compute_kind(name: str, version: int, dtype: np.dtype) -> int:
    """Return the fingerprint of a message type.

    Args:
        name: Name of the message type.
        version: Version of the message type.
        dtype: Layout of its fields. Types with equal names, versions and layouts have equal
            fingerprints.
    """
    return xxh3(repr((name, version, dtype.descr)).encode())


class Sealer:
    """Seals outgoing messages and checks the seals of received ones.

    Attributes:
        flaws: Number of messages rejected for each flaw.

    Raises:
        CredentialError: The files cannot be used.
    """

    def __init__(self, credentials: Credentials | None = None) -> None:
        self._credentials = credentials
        self._pair = credentials.key_pair if credentials else None
        if credentials and self._pair:
            # Identify a sender once now, because the first identification takes as long as a cycle.
            credentials.identify_sender(self._pair.chain)
        self.flaws = dict.fromkeys(Flaw, 0)

    def seal(self, key: str, head: Envelope, payload: bytes | memoryview) -> bytes:
        """Seal a message and return its envelope.

        Args:
            key: Key expression under which the message will be sent.
            head: Head of the message.
            payload: Content of the message.
        """
        chain = self._pair.chain if self._pair else b""
        packed = _HEAD.pack(_MAGIC, head.flags, len(chain), *head[:7], head.age_ns) + chain
        digest = _compute_digest(key, packed, payload)
        return packed + (self._pair.sign_digest(digest) if self._pair else digest)

    def open_message(self, key: str, envelope: bytes | None, payload: bytes) -> Envelope | Flaw:
        """Check length, format and seal of a received message. Count the first flaw found.

        Args:
            key: Key expression under which the message arrived.
            envelope: Envelope of the message. None if it has none.
            payload: Content of the message.

        Returns:
            The head, or the flaw for which the message must be rejected.
        """
        if len(payload) > MAX_MESSAGE_BYTES:
            return self._count_flaw(Flaw.OVERSIZED)
        if (
            envelope is None
            or not _HEAD.size < len(envelope) <= MAX_ENVELOPE_BYTES
            or envelope[:4] != _MAGIC
        ):
            return self._count_flaw(Flaw.MALFORMED)
        _, flags, chain_bytes, *fields, age_ns = _HEAD.unpack_from(envelope)
        end = _HEAD.size + chain_bytes
        digest = _compute_digest(key, envelope[:end], payload)
        if not self._has_valid_seal(key, digest, envelope[_HEAD.size : end], envelope[end:]):
            return self._count_flaw(Flaw.UNSIGNED)
        return Envelope._make((*fields, flags, age_ns))

    def _has_valid_seal(self, key: str, digest: bytes, chain: bytes, seal: bytes) -> bool:
        """Return True if the seal was made by the sender that the key expression names.

        Without credentials, the seal must be the digest itself.
        """
        if self._credentials is None:
            return compare_digest(seal, digest)
        identity = self._credentials.identify_sender(chain)
        return (
            identity is not None
            and identity.name == parse_sender(key)
            and identity.has_signed(digest, seal)
        )

    def _count_flaw(self, flaw: Flaw) -> Flaw:
        """Count a flaw and return it."""
        self.flaws[flaw] += 1
        return flaw


def _compute_digest(key: str, packed: bytes, payload: bytes | memoryview) -> bytes:
    """Return the SHA-256 of head, certificates, key expression and payload."""
    digest = sha256(packed)
    # Include the length of the key, so that moving bytes between key and payload changes the hash.
    digest.update(f"{len(key)}:{key}".encode())
    digest.update(payload)
    return digest.digest()
