"""A second writer of a mailbox, which holds no claim."""

from __future__ import annotations

from backplane.segment import Segment


def masquerade(segment: Segment, mailbox: str, tick: int) -> None:
    """Publish a forged message in a mailbox at `tick`."""
