"""What follows when a process of a rack ends: it is recorded, and restarted or given up.

The limit and the order of restarts, and the restarts themselves: of boards, on the clock's grid; of
host boards, which are started with the run and in real time never waited for. The loss of a host
board demands nothing of the arm. The clock admits its return, as it does that of other boards.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import Layout
from rack.backplane.process import STOPPED, how_ended, state_of
from rack.backplane.segment import Segment
from rack.backplane.words import Block, TaskState
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import CrateLine
from rack.boards.crate.requests import Ended, PowerOff, PowerOn
from rack.boards.errors import CANNOT_GO_ON
from rack.boards.events import Journal
from rack.boards.wiring import ClockWiring, HostWiring, TaskWiring


class Restart(NamedTuple):
    """A restart that the policy permits: the `number`-th of at most `most` within `within_s`, s."""

    number: int
    most: int
    within_s: float

    def __str__(self) -> str:
        return f"restart {self.number} of at most {self.most} in {self.within_s:g} s"


class Supervision:
    """The restart policy of a rack. It counts in ticks, so that in lockstep the same losses have
    the same outcome."""

    def __init__(self, config: RackConfig, layout: Layout) -> None:
        self._config = config
        self._layout = layout
        self._restarts: dict[str, list[int]] = defaultdict(list)
        self._needs: dict[str, set[str]] = {CLOCK: set()}
        for task in layout.tasks:
            below = config.all_below(task.board)
            needed = {other.name for other in layout.tasks if other.board in below}
            self._needs[task.name] = {CLOCK, *needed} | (
                {task.board} if task.role == "planner" else set()
            )

    def admit(self, task: str, tick: int) -> Restart | None:
        """Count one more restart of a task, lost at `tick`; return None if no more are
        permitted."""
        most, within_s = self._policy(task)
        since = tick - within_s * 1e9 / self._layout.clock_ns
        recent = [at for at in self._restarts[task] if at > since]
        if len(recent) >= most:
            return None
        self._restarts[task] = [*recent, tick]
        return Restart(len(recent) + 1, most, within_s)

    def in_order(self, tasks: list[str]) -> list[str]:
        """Return the tasks in order of restart: the clock, then lower levels before higher,
        executor before planner."""
        # What a task needs, needs less than it does.
        return sorted(tasks, key=lambda task: len(self._needs[task]))

    def must_wait(self, task: str, absent: list[str]) -> bool:
        """Say whether a task on which this one depends is still absent: any below it, or a
        planner's executor."""
        return not self._needs[task].isdisjoint(absent)

    def _policy(self, task: str) -> tuple[int, float]:
        common = self._config.supervision
        if task == CLOCK:
            return common.restarts, common.within_s
        spec = self._layout.task(task)
        board = self._config.table(spec)
        most = common.restarts if board.restarts is None else board.restarts
        return most, common.within_s if board.restarts_within_s is None else board.restarts_within_s


class Recovery:
    """The lost boards of a run, from loss to return.

    A board is powered on again once everything on which it depends is present; it rejoins on the
    clock's grid.
    """

    def __init__(
        self,
        segment: Segment,
        supervision: Supervision,
        wirings: Mapping[str, TaskWiring | ClockWiring],
        crate: CrateLine,
    ) -> None:
        self._segment = segment
        self._supervision = supervision
        self._wirings = wirings
        self._crate = crate
        self._waiting: list[str] = []
        self._starting: list[str] = []

    def lose(self, board: str, tick: int, is_final: bool = False) -> Restart | None:
        """Schedule the restart of a board whose process has ended; return None if it is given up,
        as one `is_final`."""
        self._starting = [name for name in self._starting if name != board]
        restart = None if is_final else self._supervision.admit(board, tick)
        if restart is not None:
            self._waiting.append(board)
        elif board != CLOCK:
            # The clock reacts to this: it brakes the arm and ends the run.
            self._segment.block(board)[Block.STATE] = TaskState.GIVEN_UP
        return restart

    def end_hanging(self, board: str) -> None:
        """Kill a hanging board, which is then lost like any other; one that is being restarted is
        left alone."""
        if board not in (*self._waiting, *self._starting):
            self._crate.ask(PowerOff(board))

    def advance(self) -> list[str]:
        """Power on the boards that are due; return them."""
        self._starting = [name for name in self._starting if self._is_absent(name)]
        absent = [*self._waiting, *self._starting]
        in_order = self._supervision.in_order(self._waiting)
        due = [board for board in in_order if not self._supervision.must_wait(board, absent)]
        for board in due:
            self._waiting.remove(board)
            self._starting.append(board)
            self._crate.ask(PowerOn(board, self._wirings[board]))
        return due

    def _is_absent(self, board: str) -> bool:
        if board == CLOCK:
            return False
        return self._segment.block(board)[Block.STATE] not in (TaskState.READY, TaskState.RUNNING)


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


class LostBoards:
    """The boards that a rack has lost, and what became of them."""

    def __init__(self, journal: Journal) -> None:
        self.faults: list[str] = []  # a line for each that was given up
        self.given_up = False  # a board, or all of them with the crate
        self.is_beyond_help = False  # the run cannot go on
        self._journal = journal
        self._recovery: Recovery | None = None  # None: the run has not begun
        self._hosts: HostBoards | None = None

    def begin(self, recovery: Recovery, hosts: HostBoards) -> None:
        """Restart boards from now on."""
        self._recovery = recovery
        self._hosts = hosts

    def lose(self, end: Ended, is_over: bool, record_printed: Callable[[], None]) -> None:
        """Record the end of a board, and restart it or give it up; `is_over`: so is the run.

        `record_printed` records what boards have printed.
        """
        if self._hosts is not None and end.name in self._hosts:
            if not self._hosts.lose(end, how_ended(end.status)):
                self.faults.append(
                    f"host board '{end.name}' ended: {how_ended(end.status)}; no restarts left"
                )
            return
        text = f"board '{end.name}' ended: {how_ended(end.status)}"
        self._journal.add("died", end.name, text, "died", end.seen_ns, end.tick)
        if self._recovery is None or is_over:
            self._give_up(end.name, text)
            return
        is_final = end.status == CANNOT_GO_ON
        if is_final:
            record_printed()
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
        printed = (event.text for event in reversed(self._journal.events))
        return next((text for text in printed if text.startswith(f"board '{board}': ")), "")

    def _give_up(self, board: str, text: str) -> None:
        self.faults.append(text)
        self.given_up = True
        self._journal.add("reaction", board, f"gave up on '{board}'", "given_up")
