"""The desk of a rack's network adapter: it sets the emergency stop when another machine asks for
it, in the adapter's cycles.

Those named in `adapter.lan.estop_from` may ask. What is malformed, unsigned or comes from anybody
else gets no answer. A cycle looks at a bounded number of requests; newer ones overwrite the rest,
and whoever gets no answer asks again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any

from xxhash import xxh3_64_intdigest as xxh3

from rack.backplane.lines import UtilityLines
from rack.backplane.message import fill_counts
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm
from rack.boards.lan.envelope import Envelope, Flaw
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.keys import estop_answer_key, estop_key
from rack.boards.lan.link import LanLink, Question
from rack.boards.lan.status import LanDesk, zero_counts
from rack.levels.level import Finding

ESTOP_KIND = xxh3(b"rack estop 1")
CHECK = 1
"""Flags of a request that is answered as a stop would be, and sets none."""
REQUESTS_A_CYCLE = 16
"""Requests that wait for a cycle, and that a cycle looks at."""


class Desk:
    """Sets the emergency stop of one rack. Each one is reported in the `findings`."""

    def __init__(
        self, segment: Segment, grid: OwnGrid, askers: Mapping[str, int], findings: list[Finding]
    ) -> None:
        """Answer the `askers`, each with the number by which alarms name it."""
        self._rack = segment.rack
        self._grid = grid
        self._askers = askers
        self._findings = findings
        self._lines = UtilityLines(segment)
        self._requests: Callable[[], Iterator[Question]] = lambda: iter(())
        self.count = zero_counts(LanDesk)

    def open(self, link: LanLink, launch: int) -> None:
        """Take requests from now on."""
        self._sealer = link.sealer
        self._launch = launch
        if self._askers:
            self._requests = link.answer(estop_key("*", self._rack), REQUESTS_A_CYCLE)

    def answer(self, tick: int) -> None:
        """Answer the requests that have come."""
        for asked, reply in self._requests():
            head = self._sealer.opened(*asked)
            asker = asked.key.split("/")[1]
            if isinstance(head, Flaw) or head.kind != ESTOP_KIND or asked.payload:
                self.count.dropped += 1
                continue
            if asker not in self._askers:
                self.count.refused += 1
                continue
            self.count.answered += 1
            if head.flags != CHECK:
                if not self._lines.emergency_stop:
                    self._findings.append(Finding(Alarm.REMOTE_STOP, self._askers[asker]))
                self._lines.latch_emergency_stop()
            # With session and number of the request: it cannot pass for the answer to another one.
            answer = Envelope(ESTOP_KIND, self._launch, head.serial, head.launch, tick, 0, 0)
            reply(b"", self._sealer.seal(estop_answer_key(self._rack, asker), answer, b""))

    def resume(self, record: Any) -> None:
        """Count on from the group of its predecessor's last status."""
        self.count.record[...] = record

    def fill(self, record: object) -> None:
        """Write its counts into the group of a status; in lockstep none, since they do not depend
        on ticks alone.
        """
        if not self._grid.is_lockstep:
            fill_counts(record, self.count.record.item())
