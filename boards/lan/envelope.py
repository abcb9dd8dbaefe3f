"""The envelope of a message on the network: from which launch and which write it is, when it was
written, and a seal.

The payload is the message as it lies in its mailbox; nothing is decoded before the seal is checked.
The seal is a keyed BLAKE2b over key expression, head and payload: a message cannot be changed, nor
passed off as another mailbox's. With an empty secret it detects damage only.
"""

from __future__ import annotations

from collections.abc import Iterable
from enum import IntEnum
from hashlib import blake2b
from hmac import compare_digest
from struct import Struct
from typing import NamedTuple

import numpy as np
from xxhash import xxh3_64_intdigest as xxh3

SEAL_BYTES = 16
_HEAD = Struct("<4sIQQQQqqq")
_MAGIC = b"RLN1"
HEAD_BYTES = _HEAD.size + SEAL_BYTES


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
    """Seals and opens envelopes with one secret. `flaws`: how often it has found each flaw."""

    def __init__(self, secret: bytes = b"", most_bytes: int = 1 << 20) -> None:
        self._secret = secret
        self._most = most_bytes
        self.flaws = dict.fromkeys(Flaw, 0)

    def taking(self, most_bytes: int) -> Sealer:
        """Return one with the same secret, another limit, and common counts."""
        sealer = Sealer(self._secret, most_bytes)
        sealer.flaws = self.flaws
        return sealer

    def resume(self, flaws: Iterable[int]) -> None:
        """Count on from the flaws that a predecessor has found."""
        self.flaws |= zip(Flaw, flaws, strict=False)

    def seal(self, key: str, head: Envelope, payload: bytes | memoryview) -> bytes:
        """Return the envelope of a payload to be sent under a key expression."""
        packed = _HEAD.pack(_MAGIC, head.flags, *head[:7])
        return packed + self._seal(key, packed, payload)

    def opened(self, key: str, envelope: bytes | None, payload: bytes) -> Envelope | Flaw:
        """Return the head of what has come under a key expression, or what is wrong with it, which
        is counted."""
        if len(payload) > self._most:
            return self._flawed(Flaw.OVERSIZED)
        if envelope is None or len(envelope) != HEAD_BYTES or envelope[:4] != _MAGIC:
            return self._flawed(Flaw.MALFORMED)
        packed = envelope[: _HEAD.size]
        if not compare_digest(envelope[_HEAD.size :], self._seal(key, packed, payload)):
            return self._flawed(Flaw.UNSIGNED)
        _, flags, *rest = _HEAD.unpack(packed)
        return Envelope._make((*rest, flags))

    def _flawed(self, flaw: Flaw) -> Flaw:
        self.flaws[flaw] += 1
        return flaw

    def _seal(self, key: str, packed: bytes, payload: bytes | memoryview) -> bytes:
        found = blake2b(packed, digest_size=SEAL_BYTES, key=self._secret)
        # With its length: what ends the key and what begins the payload cannot change places.
        found.update(f"{len(key)}:{key}".encode())
        found.update(payload)
        return found.digest()
