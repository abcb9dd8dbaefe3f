"""What follows when a process of a rack ends: it is recorded, and restarted or given up."""

from __future__ import annotations

from collections.abc import Callable

from rack.backplane.address_map import CLOCK
from rack.backplane.process import how_ended
from rack.boards.crate.hosts import HostBoards
from rack.boards.crate.recovery import Recovery
from rack.boards.crate.requests import Ended
from rack.boards.errors import CANNOT_GO_ON, CANNOT_KEEP
from rack.boards.events import Journal


class LostBoards:
    """The boards that a rack has lost, and what became of them. `record_printed` records what they
    have printed."""

    def __init__(self, journal: Journal, record_printed: Callable[[], None]) -> None:
        self.faults: list[str] = []  # a line for each that was given up
        self.given_up = False  # a board, or all of them with the crate
        self.is_beyond_help = False  # the run cannot go on
        self.cannot_keep = False  # a board ended because it has no checkpoint to give
        self._journal = journal
        self._record_printed = record_printed
        self._recovery: Recovery | None = None  # None: the run has not begun
        self._hosts: HostBoards | None = None

    def begin(self, recovery: Recovery, hosts: HostBoards) -> None:
        """Restart boards from now on."""
        self._recovery = recovery
        self._hosts = hosts

    def lose(self, end: Ended, is_over: bool) -> None:
        """Record the end of a board, and restart it or give it up; `is_over`: so is the run."""
        if self._hosts is not None and end.name in self._hosts:
            if not self._hosts.lose(end, how_ended(end.status)):
                self.faults.append(
                    f"host board '{end.name}' ended: {how_ended(end.status)}; no restarts left"
                )
            return
        text = f"board '{end.name}' ended: {how_ended(end.status)}"
        self.cannot_keep |= end.status == CANNOT_KEEP
        self._journal.add("died", end.name, text, "died", end.seen_ns, end.tick)
        if self._recovery is None or is_over:
            self._give_up(end.name, text)
            return
        is_final = end.status in (CANNOT_GO_ON, CANNOT_KEEP)
        if is_final:
            text = self._reason(end.name) or text
        restart = self._recovery.lose(end.name, end.tick, is_final)
        if restart is None:
            self.is_beyond_help = end.name == CLOCK
            self._give_up(end.name, text if is_final else f"{text}; no restarts left")
        else:
            self._journal.add("reaction", end.name, str(restart), "restart")

    def lose_crate(self) -> None:
        """Record the end of the crate."""
        self.is_beyond_help = True
        text = "the crate ended, and all boards with it"
        self._journal.add("died", "crate", text, "died")
        self._give_up("crate", text)

    def _reason(self, board: str) -> str:
        """Return the reason that a board printed last; empty: none."""
        self._record_printed()
        printed = (event.text for event in reversed(self._journal.events))
        return next((text for text in printed if text.startswith(f"board '{board}': ")), "")

    def _give_up(self, board: str, text: str) -> None:
        self.faults.append(text)
        self.given_up = True
        self._journal.add("reaction", board, f"gave up on '{board}'", "given_up")
