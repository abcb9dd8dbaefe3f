"""A running rack to look at and to command: on this machine, or by HOST/RACK on another one."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Protocol, Self

from rack.backplane.segment import Segment
from rack.tools.console.interrupt import INTERRUPT

if TYPE_CHECKING:
    from rack.backplane.operator_table import Client, Request, RequestEntry
    from rack.tools.console.address import Asker

LOOK_S = 0.001


class WatchedRack(AbstractContextManager["WatchedRack"], Protocol):
    """A rack in a context, with its segment as of the last `refresh`; on this machine that is
    always up to date."""

    @property
    def segment(self) -> Segment:
        """The rack's segment, or a mirror of it."""

    def refresh(self) -> bool:
        """Bring the segment up to date, or wait a moment; False when the rack is out of reach."""

    def follow(self, mailbox: str) -> None:
        """Let no message of a mailbox be missing from now on, as far as its slots reach back."""

    def claim(self, request: Request, client: Client) -> AbstractContextManager[RequestEntry]:
        """Add a request as its client. At the end of the `with` block end its lease, or withdraw it
        unless it has been issued."""


class LocalRack:
    """A rack on this machine. Raises `SegmentError` when there is none."""

    def __init__(self, rack: str) -> None:
        self.segment = Segment.attach(rack)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.segment.close()

    def refresh(self) -> bool:
        """Wait a moment."""
        time.sleep(LOOK_S)
        return True

    def follow(self, mailbox: str) -> None:
        """Do nothing: all messages are here."""

    def claim(self, request: Request, client: Client) -> AbstractContextManager[RequestEntry]:
        """Add a request to the operator table."""
        from rack.backplane.operator_table import OperatorTable

        return OperatorTable(self.segment).claim(request, client)


def looks(segment: Segment, look_s: float) -> Iterator[bool]:
    """Yield again and again whether the run is over, until it is, or a signal asks for the end."""
    ended = threading.Event()
    is_last = False
    with INTERRUPT.orderly(ended.set):
        while not is_last:
            # Asked before the look: what is written until the end is seen.
            is_over = segment.run_is_over
            is_last = is_over or ended.wait(look_s)
            yield is_over


def watched(rack: str, asker: Asker | None = None) -> WatchedRack:
    """Return a rack by its name, or by HOST/RACK, which `asker` asks.

    Raises `SegmentError` when there is none, or `Failure` for one on another machine.
    """
    if "/" not in rack:
        return LocalRack(rack)
    # Here, not above: `rack status` of a rack on this machine does without a parser.
    from rack.tools.console.address import Asker, RackAddress, needing_zenoh

    address = RackAddress.of(rack)
    with needing_zenoh():
        from rack.tools.network.remote import RemoteRack
    return RemoteRack(address, asker or Asker.default())
