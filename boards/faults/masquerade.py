"""A second writer of a mailbox, which holds no claim."""

from __future__ import annotations

import os

from rack.backplane.mailbox.slots import Slots, claim
from rack.backplane.segment import Segment
from rack.backplane.words import Box


def masquerade(segment: Segment, mailbox: str, tick: int) -> None:
    """Publish a forged message in a mailbox, visible at `tick`: a sound one, but for who has signed it.

    Its content is the newest message's with every bit turned over, so that it would show wherever it is believed.
    """
    slots = Slots(segment, segment.layout.mailbox(mailbox))
    head = slots.box[Box.HEAD]
    if head:
        slots.fetch(head)
    slots.message.raw[:] = bytes(byte ^ 0xFF for byte in slots.message.raw)
    slots.resume(claim(slots.box[Box.EPOCH], os.getpid()))
    slots.publish(tick, tick, tick)
