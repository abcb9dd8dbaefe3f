"""The envelope of a message on the network: from which launch and which write it is, when it was
written, and a seal.

The payload is the message as it lies in its mailbox; nothing is decoded before the seal is checked.
The seal is a signature over key expression, head and payload, with the key of the sender's
certificate, which travels along: a message cannot be changed, nor passed off as another mailbox's,
nor made by another rack in the sender's name. Without certificates it detects damage only.

Alternatives considered: one secret for all racks (each can speak for any other), one for each pair
(a mailbox has many readers, so a message would have many seals), certificates of all in each folder
(they would all change whenever one is renewed).
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum
from hashlib import sha256
from hmac import compare_digest
from struct import Struct
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from xxhash import xxh3_64_intdigest as xxh3

from rack.boards.lan.config import MOST_CHAIN
from rack.boards.lan.keys import sender_of

if TYPE_CHECKING:
    from rack.boards.lan.credentials import Credentials

_HEAD = Struct("<4sIHQQQQqqq")
_MAGIC = b"RLN2"
MOST_SEAL = 72
"""Bytes of the longest seal."""
MOST_ENVELOPE = _HEAD.size + MOST_CHAIN + MOST_SEAL


class Envelope(NamedTuple):
    """The head of a message."""

    kind: int  # fingerprint of its type: see `kind_of`
    launch: int  # random number of the launch whose backplane it is from
    serial: int  # of the message in its mailbox; of a question, answer or sign, its own
    # of the message among those sent from its mailbox: it rises by one, `serial` may by more
    number: int
    tick: int  # release of the cycle that wrote it, on its rack's grid
    time_ns: int  # simulated time of that tick
    stamp_ns: int  # CLOCK_MONOTONIC of that tick on its machine; in lockstep the simulated time
    flags: int = 0


class Flaw(IntEnum):
    """What is wrong with something that came from the network."""

    MALFORMED = 1  # no head, or not of this version
    UNSIGNED = 2  # the seal does not fit
    OVERSIZED = 3  # longer than permitted


def kind_of(name: str, version: int, dtype: np.dtype) -> int:
    """Return the fingerprint of a message type: equal for equal names, versions and layouts."""
    return xxh3(repr((name, version, dtype.descr)).encode())


class Sealer:
    """Seals and opens envelopes. `flaws`: how often it has found each flaw.

    Raises `Credential` if the files cannot be used.
    """

    def __init__(self, credentials: Credentials | None = None, most_bytes: int = 1 << 20) -> None:
        self._credentials = credentials
        self._pair = credentials.pair if credentials else None
        if credentials and self._pair:
            # Here, not in a cycle: the first one takes as long as one.
            credentials.identity(self._pair.chain)
        self._most = most_bytes
        self.flaws = dict.fromkeys(Flaw, 0)

    def taking(self, most_bytes: int) -> Sealer:
        """Return one with the same credentials, another limit, and common counts."""
        sealer = Sealer(self._credentials, most_bytes)
        sealer.flaws = self.flaws
        return sealer

    def resume(self, flaws: Iterable[int]) -> None:
        """Count on from the flaws that a predecessor has found."""
        self.flaws |= zip(Flaw, flaws, strict=False)

    def seal(self, key: str, head: Envelope, payload: bytes | memoryview) -> bytes:
        """Return the envelope of a payload to be sent under a key expression."""
        chain = self._pair.chain if self._pair else b""
        packed = _HEAD.pack(_MAGIC, head.flags, len(chain), *head[:7]) + chain
        digest = _digest(key, packed, payload)
        return packed + (self._pair.sign(digest) if self._pair else digest)

    def opened(self, key: str, envelope: bytes | None, payload: bytes) -> Envelope | Flaw:
        """Return the head of what has come under a key expression, or what is wrong with it, which
        is counted.
        """
        if len(payload) > self._most:
            return self._flawed(Flaw.OVERSIZED)
        if (
            envelope is None
            or not _HEAD.size < len(envelope) <= MOST_ENVELOPE
            or envelope[:4] != _MAGIC
        ):
            return self._flawed(Flaw.MALFORMED)
        _, flags, length, *rest = _HEAD.unpack_from(envelope)
        end = _HEAD.size + length
        digest = _digest(key, envelope[:end], payload)
        if not self._is_sealed(key, digest, envelope[_HEAD.size : end], envelope[end:]):
            return self._flawed(Flaw.UNSIGNED)
        return Envelope._make((*rest, flags))

    def _is_sealed(self, key: str, digest: bytes, chain: bytes, seal: bytes) -> bool:
        """Say whether the one in whose name something comes has sealed it."""
        if self._credentials is None:
            return compare_digest(seal, digest)
        identity = self._credentials.identity(chain)
        return (
            identity is not None
            and identity.name == sender_of(key)
            and identity.has_signed(digest, seal)
        )

    def _flawed(self, flaw: Flaw) -> Flaw:
        self.flaws[flaw] += 1
        return flaw


def _digest(key: str, packed: bytes, payload: bytes | memoryview) -> bytes:
    found = sha256(packed)
    # With its length: what ends the key and what begins the payload cannot change places.
    found.update(f"{len(key)}:{key}".encode())
    found.update(payload)
    return found.digest()
