"""What follows when a process of a rack ends: it is recorded, and restarted or given up.

The limit and the order of restarts, and the restarts themselves: of boards, on the clock's grid; of
host boards, which in real time are never waited for. The loss of a host board demands nothing of
the arm. The clock admits its return, as it does that of other boards.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import Layout
from rack.backplane.process import STOPPED, how_ended, state_of
from rack.backplane.segment import Segment
from rack.backplane.words import Block, TaskState
from rack.boards.config.resolved import Resolved
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import CrateLine
from rack.boards.crate.requests import Ended, PowerOff, PowerOn
from rack.boards.errors import CANNOT_GO_ON
from rack.boards.events import Journal
from rack.boards.wiring import ClockWiring, HostWiring, TaskWiring

UP = (TaskState.READY, TaskState.RUNNING)
"""States of a board that has passed its self-test."""


class Supervision:
    """The restart policy of a rack. It counts in ticks, so that in lockstep the same losses have
    the same outcome.
    """

    def __init__(self, config: RackConfig, layout: Layout) -> None:
        self._config = config
        self._layout = layout
        self._restarts: dict[str, list[int]] = defaultdict(list)
        # Of the clock and of host boards nothing.
        self._needs: dict[str, set[str]] = defaultdict(set)
        for task in layout.tasks:
            below = config.all_below(task.board)
            needed = {other.name for other in layout.tasks if other.board in below}
            self._needs[task.name] = {CLOCK, *needed} | (
                {task.board} if task.role == "planner" else set()
            )

    def admit(self, task: str, tick: int) -> str:
        """Count one more restart of a task, lost at `tick`; return which one it is, as text, empty
        if no more are permitted.
        """
        common = self._config.supervision
        most, within_s = common.restarts, common.within_s
        if task != CLOCK:
            board = self._config.table(self._layout.task(task))
            most = most if board.restarts is None else board.restarts
            own_s = board.restarts_within_s
            within_s = within_s if own_s is None else own_s
        since = tick - within_s * 1e9 / self._layout.clock_ns
        recent = [at for at in self._restarts[task] if at > since]
        if len(recent) >= most:
            return ""
        self._restarts[task] = [*recent, tick]
        return f"restart {len(recent) + 1} of at most {most} in {within_s:g} s"

    def in_order(self, tasks: list[str]) -> list[str]:
        """Return the tasks in order of restart: the clock, then lower levels before higher,
        executor before planner.
        """
        # A task always needs more than any task that it needs, so sorting by count is enough.
        return sorted(tasks, key=lambda task: len(self._needs[task]))

    def must_wait(self, task: str, absent: list[str]) -> bool:
        """Say whether a task on which this one depends is still absent: any below it, or a
        planner's executor.
        """
        return not self._needs[task].isdisjoint(absent)


class Recovery:
    """The lost boards of a rack, from loss to return.

    A board is powered on again once everything on which it depends is present; it rejoins on the
    clock's grid.

    Attributes:
        wirings: The boards of the run, and its host boards that are not external, by name. Before
            the run there are none, and no board is restarted.
        faults: A line for each board that was given up.
        given_up: Whether a board, or all of them with the crate, was given up.
        is_beyond_help: Whether the run cannot go on.
    """

    def __init__(
        self, segment: Segment, supervision: Supervision, crate: CrateLine, journal: Journal
    ) -> None:
        self.wirings: Mapping[str, TaskWiring | ClockWiring | HostWiring] = {}
        self.faults: list[str] = []
        self.given_up = False
        self.is_beyond_help = False
        self._segment = segment
        self._supervision = supervision
        self._crate = crate
        self._journal = journal
        self._waiting: list[str] = []
        self._starting: list[str] = []
        self._stopped: set[str] = set()

    def start(self, clock: ClockWiring, plan: Resolved) -> None:
        """Power on the clock and the host boards; restart boards from now on."""
        self.wirings = {
            CLOCK: clock,
            **{host.board: host for host in plan.hosts if not host.is_external},
            **{task.task: task for task in plan.tasks},
        }
        for name, wiring in self.wirings.items():
            if not isinstance(wiring, TaskWiring):
                self._crate.ask(PowerOn(name, wiring))

    def lose(self, end: Ended, is_over: bool, record_printed: Callable[[], None]) -> None:
        """Record the end of a board, and restart it or give it up; `is_over`: so is the run.

        `record_printed` records what boards have printed.
        """
        name = end.name
        is_host = isinstance(self.wirings.get(name), HostWiring)
        self._starting = [other for other in self._starting if other != name]
        self._stopped.discard(name)
        if is_host and self._segment.block(name)[Block.STATE] == TaskState.ENDED:
            self._journal.add("done", name, f"host board '{name}': its program is done", "done")
            return
        text = f"{'host ' * is_host}board '{name}' ended: {how_ended(end.status)}"
        self._journal.add("died", name, text, "died", end.seen_ns, end.tick)
        if not self.wirings or (is_over and not is_host):
            self._give_up(name, text)
            return
        if end.status == CANNOT_GO_ON and not is_host:
            record_printed()
            text = self._reason(name) or text
        elif restart := self._supervision.admit(name, end.tick):
            self._waiting.append(name)
            self._journal.add("reaction", name, restart, "restart")
            return
        else:
            text = f"{text}; no restarts left"
        if name == CLOCK:
            self.is_beyond_help = True
        else:
            # The clock reacts to this: it brakes the arm and ends the run.
            self._segment.block(name)[Block.STATE] = TaskState.GIVEN_UP
        self._give_up(name, text, is_host)

    def lose_crate(self) -> None:
        """Record the end of the crate."""
        self.is_beyond_help = True
        text = "the crate ended, and all boards with it"
        self._journal.add("died", "crate", text, "died")
        self._give_up("crate", text)

    def report_hanging(self, board: str, why: str = "") -> None:
        """Record that a board hangs."""
        text = f"'{board}' is not responding{why}"
        self._journal.add("detection", "rack", text, "hang", subject=board)

    def end_hanging(self, board: str) -> None:
        """Kill a hanging board, which is then lost like any other; one that is being restarted is
        left alone.
        """
        if board not in (*self._waiting, *self._starting):
            self._crate.ask(PowerOff(board))

    def advance(self) -> None:
        """Power on the boards that are due, and end host boards that a signal has stopped: nothing
        else shows that one hangs.
        """
        self._starting = [
            name
            for name in self._starting
            if name != CLOCK and self._segment.block(name)[Block.STATE] not in UP
        ]
        absent = [*self._waiting, *self._starting]
        for board in self._supervision.in_order(self._waiting):
            if not self._supervision.must_wait(board, absent):
                self._waiting.remove(board)
                self._starting.append(board)
                self._crate.ask(PowerOn(board, self.wirings[board]))
        hosts = {name for name, wiring in self.wirings.items() if isinstance(wiring, HostWiring)}
        for name in hosts - self._stopped:
            if state_of(self._segment.block(name)[Block.PID]) in STOPPED:
                self._stopped.add(name)
                self.report_hanging(name, ": stopped by a signal")
                self._crate.ask(PowerOff(name))

    def _reason(self, board: str) -> str:
        """Return the reason that a board printed last; empty: none."""
        printed = (event.text for event in reversed(self._journal.events))
        return next((text for text in printed if text.startswith(f"board '{board}': ")), "")

    def _give_up(self, board: str, text: str, is_host: bool = False) -> None:
        self.faults.append(text)
        self.given_up |= not is_host
        self._journal.add("reaction", board, f"gave up on '{board}'", "given_up")
