"""Votes of three copies: a copy has strayed if its messages differ from both others.

Each standby stores a checksum of the messages that it holds back in its control block. A standby
that finds a difference to the active copy compares its own checksum with that of the third copy. If
these are equal, the active copy has strayed. If the third copy agrees with the active one, the
standby itself has. The clock takes that copy out: see `rack.boards.run.hand_over`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from xxhash import xxh3_64

from rack.backplane.words import Block

_SIGN = 1 << 63


def compute_checksum(messages: Iterable[bytes | memoryview]) -> int:
    """Return a checksum of messages as a signed word."""
    checksum = xxh3_64()
    for message in messages:
        checksum.update(message)
    return checksum.intdigest() - _SIGN


class Ballot:
    """The checksums of three copies.

    Args:
        blocks: Control blocks of all copies.
        number: Number of this copy.
        every: Period of the task in ticks.
    """

    def __init__(self, blocks: Sequence[memoryview], number: int, every: int) -> None:
        self._blocks = blocks
        self._number = number
        self._every = every
        self._checksum = 0

    def cast_vote(self, tick: int, messages: Iterable[bytes | memoryview]) -> None:
        """Store the checksum of the messages held back in the cycle released at `tick`."""
        self._checksum = compute_checksum(messages)
        block = self._blocks[self._number]
        at = self._find_words(tick)
        block[at] = 0
        block[at + 1] = self._checksum
        block[at] = tick + 1

    def find_stray(self, tick: int, active: int, messages: Iterable[memoryview]) -> int | None:
        """Return the number of the copy that has strayed in a cycle. None if there is no majority.

        Args:
            tick: Release tick of the cycle.
            active: Number of the active copy, whose messages differ from those of this copy.
            messages: Messages of the active copy, in the order of `cast_vote`.
        """
        at = self._find_words(tick)
        for number, block in enumerate(self._blocks):
            if number in (active, self._number) or block[at] != tick + 1:
                continue
            checksum = block[at + 1]
            if block[at] != tick + 1:
                continue
            if checksum == self._checksum:
                return active
            if checksum == compute_checksum(messages):
                return self._number
        return None

    def _find_words(self, tick: int) -> int:
        """Return the first of two words for a cycle. Successive cycles have different words."""
        return Block.BALLOT + 2 * (tick // self._every % 2)
