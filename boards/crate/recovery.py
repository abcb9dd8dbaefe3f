"""Restarts of lost boards: their limit, their order, and their execution.

The end of each process is recorded, and the board is restarted if the restart policy permits it.
Boards rejoin on the clock's grid, host boards too. In real time nothing waits for host boards, and
their loss has no effect on the arm.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence

from rack.backplane.address_map import CLOCK, CLOCK_STANDBY
from rack.backplane.layout import Layout
from rack.backplane.process import STOPPED_STATES, describe_end, read_state
from rack.backplane.segment import Segment
from rack.backplane.words import Block, TaskState
from rack.boards.config.resolved import Resolved
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import CrateLine
from rack.boards.crate.requests import Ended, PowerOff, PowerOn
from rack.boards.errors import UNRECOVERABLE_STATUS
from rack.boards.events import Journal
from rack.boards.wiring import ClockWiring, HostWiring, TaskWiring

CLOCKS = (CLOCK, CLOCK_STANDBY)
UP_STATES = (TaskState.READY, TaskState.RUNNING)
"""States of a board that has passed its self-test and has not ended."""


class RestartPolicy:
    """Decides whether and when lost tasks of a rack are restarted.

    Times are in ticks, so that a repeated lockstep run makes the same decisions.
    """

    def __init__(self, config: RackConfig, layout: Layout) -> None:
        self._config = config
        self._layout = layout
        self._restarts: dict[str, list[int]] = defaultdict(list)
        # Tasks on which each task depends. The clock and host boards depend on no task.
        self._needs: dict[str, set[str]] = defaultdict(set)
        for task in layout.tasks:
            below = config.find_boards_below(task.board)
            needed = {
                other.name
                for other in layout.tasks
                if other.board in below and other.role != "standby"
            }
            self._needs[task.name] = {CLOCK, *needed}
            if task.role == "planner":
                self._needs[task.name].add(task.board)

    def admit_restart(self, task: str, tick: int) -> str:
        """Decide whether a task that was lost at `tick` may be restarted, and if so, count it.

        Returns:
            Text such as "restart 1 of at most 3 in 60 s". Empty if no restart is permitted.
        """
        common = self._config.supervision
        max_restarts, within_s = common.restarts, common.within_s
        if task not in CLOCKS:
            board = self._config.get_table(self._layout.find_task(task))
            max_restarts = max_restarts if board.restarts is None else board.restarts
            board_s = board.restarts_within_s
            within_s = within_s if board_s is None else board_s
        since = tick - within_s * 1e9 / self._layout.clock_ns
        recent = [at for at in self._restarts[task] if at > since]
        if len(recent) >= max_restarts:
            return ""
        self._restarts[task] = [*recent, tick]
        return f"restart {len(recent) + 1} of at most {max_restarts} in {within_s:g} s"

    def list_startable(self, waiting: Sequence[str], starting: Sequence[str]) -> list[str]:
        """Return the waiting tasks that depend on no absent task.

        A task depends on the clock and on all tasks below it, and a planner also on its executor.

        Args:
            waiting: Absent tasks that are to be restarted.
            starting: Absent tasks that are being restarted.
        """
        return [task for task in waiting if self._needs[task].isdisjoint((*waiting, *starting))]


class Recovery:
    """Recovery of lost boards.

    A lost board is powered on again when all boards on which it depends are present.

    Attributes:
        wirings: Wirings of all boards and of the host boards that are not external, keyed by name.
            Empty before the run, when no board is restarted.
        faults: For each board that will not be restarted, the reason.
        given_up: Whether the crate has ended, or a board that is not a host board will not be
            restarted.
        is_beyond_help: Whether the run cannot continue.
    """

    def __init__(
        self, segment: Segment, supervision: RestartPolicy, crate: CrateLine, journal: Journal
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
        """Power on the clock and the host boards, and enable restarts of lost boards."""
        self.wirings = {
            CLOCK: clock,
            **plan.build_clock_standbys(clock),
            **{host.board: host for host in plan.hosts if not host.is_external},
            **{task.task: task for task in plan.tasks},
        }
        for name, wiring in self.wirings.items():
            if not isinstance(wiring, TaskWiring):
                self._crate.try_request(PowerOn(name, wiring))

    def record_loss(self, end: Ended, is_over: bool, record_printed: Callable[[], None]) -> None:
        """Record the end of a board, and schedule a restart if one is permitted.

        Args:
            end: The crate's report on the end.
            is_over: Whether the run is over.
            record_printed: Function that records all printed lines as events.
        """
        name = end.name
        is_host = isinstance(self.wirings.get(name), HostWiring)
        self._starting = [other for other in self._starting if other != name]
        self._stopped.discard(name)
        if is_host and self._segment.get_block(name)[Block.STATE] == TaskState.ENDED:
            self._journal.add_event(
                "done", name, f"host board '{name}': its program is done", "done"
            )
            return
        text = f"{'host ' * is_host}board '{name}' ended: {describe_end(end.status)}"
        self._journal.add_event("died", name, text, "died", end.seen_ns, end.tick)
        if not self.wirings or (is_over and not is_host):
            self._record_final_loss(name, text)
            return
        if end.status == UNRECOVERABLE_STATUS and not is_host:
            record_printed()
            # The reason is in the last line that the board has printed about itself.
            printed = (event.text for event in reversed(self._journal.events))
            text = next((line for line in printed if line.startswith(f"board '{name}': ")), text)
        elif restart := self._supervision.admit_restart(name, end.tick):
            self._waiting.append(name)
            self._journal.add_event("reaction", name, restart, "restart")
            return
        else:
            text = f"{text}; no restarts left"
        if name in CLOCKS:
            others = [clock for clock in CLOCKS if clock in self.wirings and clock != name]
            self.is_beyond_help = self.is_beyond_help or not others
        else:
            # The clock reacts to this state by braking the arm and ending the run.
            self._segment.get_block(name)[Block.STATE] = TaskState.GIVEN_UP
        self._record_final_loss(name, text, is_host)

    def record_crate_loss(self) -> None:
        """Record that the crate, and therefore every board, has ended."""
        self.is_beyond_help = True
        text = "the crate ended, and all boards with it"
        self._journal.add_event("died", "crate", text, "died")
        self._record_final_loss("crate", text)

    def report_hanging(self, board: str, why: str = "") -> None:
        """Record an event which states that a board is not responding.

        Args:
            board: Name of the board.
            why: Text to append to the event, as in ": stopped by a signal". May be empty.
        """
        self._journal.add_event(
            "detection", "rack", f"'{board}' is not responding{why}", "hang", subject=board
        )

    def kill_hanging(self, board: str) -> None:
        """Kill a hanging board, which is then handled as lost. Skip one that is being restarted."""
        if board not in (*self._waiting, *self._starting):
            self._crate.try_request(PowerOff(board))

    def restart_due_boards(self) -> None:
        """Power on lost boards that need not wait for others.

        Also kill each host board that a signal has stopped, because no other check detects this.
        """
        self._starting = [
            name
            for name in self._starting
            if name not in CLOCKS and self._segment.get_block(name)[Block.STATE] not in UP_STATES
        ]
        for board in self._supervision.list_startable(self._waiting, self._starting):
            self._waiting.remove(board)
            self._starting.append(board)
            self._crate.try_request(PowerOn(board, self.wirings[board]))
        for name, wiring in self.wirings.items():
            if (
                isinstance(wiring, HostWiring)
                and name not in self._stopped
                and read_state(self._segment.get_block(name)[Block.PID]) in STOPPED_STATES
            ):
                self._stopped.add(name)
                self.report_hanging(name, ": stopped by a signal")
                self._crate.try_request(PowerOff(name))

    def _record_final_loss(self, board: str, text: str, is_host: bool = False) -> None:
        """Record that a board will not be restarted, or that the crate has ended.

        Args:
            board: Name of the board, or "crate".
            text: The reason, which becomes a fault of the run.
            is_host: Whether it is a host board, which does not end the run.
        """
        self.faults.append(text)
        self.given_up |= not is_host
        self._journal.add_event("reaction", board, f"gave up on '{board}'", "given_up")
