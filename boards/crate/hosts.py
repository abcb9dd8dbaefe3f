"""The host boards of a run: started with it, restarted by the rack's policy, in real time never
waited for.

Their loss demands nothing of the arm. The clock admits their return, as it does that of other
boards.
"""

from __future__ import annotations

from collections.abc import Sequence

from rack.backplane.process import STOPPED, state_of
from rack.backplane.segment import Segment
from rack.backplane.words import Block, TaskState
from rack.boards.crate.line import CrateLine
from rack.boards.crate.recovery import Supervision
from rack.boards.crate.requests import Ended, PowerOff, PowerOn
from rack.boards.events import Journal
from rack.boards.wiring import HostWiring


class HostBoards:
    """Starts and watches the host boards that are not external."""

    def __init__(
        self,
        segment: Segment,
        wirings: Sequence[HostWiring],
        supervision: Supervision,
        crate: CrateLine,
        journal: Journal,
    ) -> None:
        self._segment = segment
        self._supervision = supervision
        self._crate = crate
        self._journal = journal
        self._wirings = {wiring.board: wiring for wiring in wirings if not wiring.is_external}
        self._stopped: set[str] = set()

    def start(self) -> None:
        """Start all of them."""
        for name, wiring in self._wirings.items():
            self._crate.ask(PowerOn(name, wiring))

    def __contains__(self, name: str) -> bool:
        return name in self._wirings

    def lose(self, end: Ended, why: str) -> bool:
        """Record the end of a host board, and restart it unless its program is done; return False
        if it is given up."""
        block = self._segment.block(end.name)
        self._stopped.discard(end.name)
        if block[Block.STATE] == TaskState.ENDED:
            self._journal.add(
                "done", end.name, f"host board '{end.name}': its program is done", "done"
            )
            return True
        text = f"host board '{end.name}' ended: {why}"
        self._journal.add("died", end.name, text, "died", end.seen_ns, end.tick)
        restart = self._supervision.admit(end.name, end.tick)
        if restart is None:
            block[Block.STATE] = TaskState.GIVEN_UP
            self._journal.add("reaction", end.name, f"gave up on '{end.name}'", "given_up")
            return False
        self._crate.ask(PowerOn(end.name, self._wirings[end.name]))
        self._journal.add("reaction", end.name, str(restart), "restart")
        return True

    def look(self) -> None:
        """End host boards that a signal has stopped: nothing else shows that one hangs."""
        for name in self._wirings:
            block = self._segment.block(name)
            if name not in self._stopped and state_of(block[Block.PID]) in STOPPED:
                self._stopped.add(name)
                text = f"'{name}' is not responding: stopped by a signal"
                self._journal.add("detection", "rack", text, "hang", subject=name)
                self._crate.ask(PowerOff(name))
