"""Emergency stop of a rack on request of other machines, carried out in the adapter's cycles.

Only senders named in `adapter.lan.estop_from` may request it. Requests that are malformed, unsigned
or from anybody else get no answer. Each cycle processes a bounded number of requests. If more
arrive, the oldest are overwritten, and a sender that gets no answer asks again.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping

from xxhash import xxh3_64_intdigest as xxh3

from rack.backplane.lines import UtilityLines
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm
from rack.boards.host.entries import zero_counts
from rack.boards.lan.entries import Counted
from rack.boards.lan.envelope import Envelope, Flaw
from rack.boards.lan.grid import OwnGrid
from rack.boards.lan.keys import estop_answer_key, estop_key, parse_sender
from rack.boards.lan.link import LanLink, Question
from rack.boards.lan.status import LanDesk
from rack.levels.level import Finding

ESTOP_KIND = xxh3(b"rack estop 1")
CHECK_FLAG = 1
"""Flag of a request that only checks the connection. It is answered, but sets no stop."""
REQUESTS_A_CYCLE = 16
"""Maximum number of requests that are buffered for a cycle and processed in it."""


class EstopResponder(Counted):
    """Sets the emergency stop of this rack on request and adds a finding for each stop.

    Attributes:
        count: Counters of answered, refused and dropped requests.
    """

    def __init__(
        self, segment: Segment, grid: OwnGrid, askers: Mapping[str, int], findings: list[Finding]
    ) -> None:
        """Create the responder.

        Args:
            segment: Segment of the rack.
            grid: Grid of the rack.
            askers: Dictionary from the name of each permitted sender to its index in alarms.
            findings: List to which a finding is added for each stop.
        """
        self._rack = segment.rack
        self._grid = grid
        self._askers = askers
        self._findings = findings
        self._lines = UtilityLines(segment)
        self._requests: Callable[[], Iterator[Question]] = lambda: iter(())
        self.count: LanDesk = zero_counts(LanDesk)

    def open(self, link: LanLink, launch: int) -> None:
        """Start to accept requests, if any sender is permitted."""
        self._sealer = link.sealer
        self._launch = launch
        if self._askers:
            self._requests = link.open_questions(estop_key("*", self._rack), REQUESTS_A_CYCLE)

    def answer_requests(self, tick: int) -> None:
        """Answer each request of a permitted sender, and latch the stop unless it is a check."""
        for request, reply in self._requests():
            head = self._sealer.open_message(*request)
            asker = parse_sender(request.key)
            if isinstance(head, Flaw) or head.kind != ESTOP_KIND or request.payload:
                self.count.dropped += 1
                continue
            if asker not in self._askers:
                self.count.refused += 1
                continue
            self.count.answered += 1
            if head.flags != CHECK_FLAG:
                if not self._lines.emergency_stop:
                    self._findings.append(Finding(Alarm.REMOTE_STOP, self._askers[asker]))
                self._lines.latch_emergency_stop()
            # Echo session and number of the request, so that the answer fits no other request.
            answer = Envelope(ESTOP_KIND, self._launch, head.serial, head.launch, tick, 0, 0)
            seal = self._sealer.seal(estop_answer_key(self._rack, asker), answer, b"")
            reply(b"", attachment=seal)

    def write_counts(self, record: object) -> None:
        """Write the counters, except in lockstep, where they would differ from run to run."""
        if not self._grid.is_lockstep:
            super().write_counts(record)
