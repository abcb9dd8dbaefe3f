"""The digest of a run: a hash over everything every task wrote, ticks and values, no wall-clock time.

Each message carries the running hash of its mailbox, so the digest is complete even when a recorder lost
rows, and a restarted writer goes on with it. Messages that become visible after the last tick do not
count: whether they were finished is no part of the motion.
"""

from __future__ import annotations

from hashlib import blake2b

from rack.backplane.segment import Segment
from rack.backplane.slots import Slots
from rack.backplane.words import Box, System


def chains(segment: Segment, until: int) -> dict[str, tuple[int, bytes]]:
    """Return serial and running hash of every mailbox's newest message that was visible before tick `until`."""
    found = {}
    for spec in segment.layout.mailboxes:
        slots = Slots(segment, spec)
        serial = head = slots.box[Box.HEAD]
        oldest = max(0, head - slots.depth)
        # A message that is lost, damaged or forged has no hash to show: the one before it has.
        while serial > oldest and not (slots.visible_at(serial) < until and slots.fetch(serial) and slots.is_lawful(0)):
            serial -= 1
        found[spec.name] = (serial, slots.chain if serial > oldest else bytes(8))
    return found


def digest(segment: Segment, until: int | None = None) -> str:
    """Return the run's digest, 32 hexadecimal digits, up to tick `until` (default: where it stopped)."""
    stop = segment.words[System.STOP_TICK] if until is None else until
    total = blake2b(digest_size=16)
    for name, (serial, chain) in sorted(chains(segment, stop).items()):
        total.update(f"{name} {serial} ".encode() + chain)
    return total.hexdigest()
