"""What a launch needs to know, worked out from the config before any board starts."""

from __future__ import annotations

from dataclasses import dataclass

from rack.backplane.fault_table import Injection
from rack.backplane.layout import Layout
from rack.backplane.message import State
from rack.backplane.protocols import open_observer
from rack.backplane.segment import Segment
from rack.backplane.words import Block, Demand, System
from rack.boards.clock_wiring import ClockWiring
from rack.boards.config import context, shared_out, wire
from rack.boards.config.cores import obtained_core
from rack.boards.config.faults import injections
from rack.boards.config.ports import TaskPorts, all_ports
from rack.boards.config.schema import RackConfig
from rack.boards.config.timing import is_critical
from rack.boards.errors import LaunchError
from rack.boards.faults.kind import KINDS
from rack.boards.outcome import Cause
from rack.boards.transfer import Transfer
from rack.boards.wiring import TaskWiring
from rack.levels.messages import TASK_STATUS

LINGER_S = 0.5
"""Simulated time that a run goes on behind the task's end: the arm is seen at rest."""
SILENT_S = 30.0
"""Simulated time, at least, for which nothing may be heard of the level that ends the run; a slow one has 8 cycles."""
HISTORY_S = 1.0
"""Simulated time by which lockstep may be ahead of a recorder: half of what the rings hold."""


PERMIT = (
    "To permit it: a line '@GROUP - rtprio 99' in /etc/security/limits.conf for a group of yours, and a new login "
    "(ulimit -r shows it); or CAP_SYS_NICE"
)
"""What to do where a user may not have a real-time priority."""


@dataclass(frozen=True)
class Launch:
    """A config, wired: the layout, and every task with its ports."""

    config: RackConfig
    layout: Layout
    tasks: tuple[TaskWiring, ...]
    faults: tuple[Injection, ...]

    @classmethod
    def of(cls, config: RackConfig) -> Launch:
        """Wire a config. Raises `ConfigError` with every mistake."""
        layout = wire(config)
        faults = injections(config, layout)
        failing = {layout.tasks[fault.task].name for fault in faults if KINDS[fault.kind].where == "start"}
        tasks = tuple(_task(config, layout, ports, ports.task in failing) for ports in all_ports(config, []))
        return cls(config, layout, tasks, faults)

    def clock(self, seconds: float | None) -> ClockWiring:
        """Return how the run goes in time; it lasts `seconds` of simulated time, or until the task ends."""
        clock, tick_ns = self.config.clock, self.config.clock_ns
        return ClockWiring(
            lockstep=clock.mode == "lockstep",
            period_ns=round(tick_ns / clock.speed),
            stop_tick=0 if seconds is None else max(1, round(seconds * 1e9 / tick_ns)),
            ends_run=self.ends_run,
            linger=round(LINGER_S * 1e9 / tick_ns),
            silent=self._silent_ticks,
            history=round(HISTORY_S * 1e9 / tick_ns),
            core=obtained_core(clock.core),
            priority=clock.priority,
            restart_ticks=max(1, round(self.config.supervision.lockstep_restart_s * 1e9 / tick_ns)),
            on_loss={task.name: self._on_loss(task.board) for task in self.layout.tasks if task.role == "executor"},
        )

    def _on_loss(self, board: str) -> Demand:
        """Return what the loss of a board asks of the arm; where its neighbour holds, nothing."""
        return {"hold": Demand.NONE, "stop": Demand.STOP, "brake": Demand.BRAKE}[self.config.board[board].on_loss]

    @property
    def crate_priority(self) -> int:
        """SCHED_FIFO priority of the crate: below every board's that has one, above everything ordinary."""
        priorities = [task.priority for task in self.layout.tasks if task.priority and task.role == "executor"]
        return max(min(priorities, default=0) - 1, 0)

    @property
    def ends_run(self) -> str | None:
        """The status mailbox whose state ends the run; None when no level does."""
        return next((f"{name}.status" for name, board in self.config.board.items() if board.ends_run), None)

    def final_state(self, segment: Segment) -> tuple[str, str]:
        """Return state and reason of the level that ends the run, as last written."""
        if self.ends_run is None:
            return "", ""
        status = open_observer(segment, self.ends_run).peek().value
        silent_s = self._silence(segment) * self.layout.clock_ns * 1e-9
        reason = f"nothing heard of '{self.ends_run}' for {silent_s:g} s" if silent_s else status.reason
        return State(status.state).name.lower(), reason

    def latched(self, segment: Segment) -> list[str]:
        """Return a line for every level but the one that ends the run whose last status holds an error."""
        found = []
        for box in segment.layout.mailboxes:
            board, _, port = box.name.partition(".")
            if port != "status" or box.name == self.ends_run or "error" not in (field.name for field in box.fields):
                continue
            status = open_observer(segment, box.name).peek()
            if status.is_there and status.value.error:
                found.append(f"level '{board}': {status.value.reason}")
        return found

    def cause_of(self, segment: Segment) -> Cause:
        """Return why a run ended that nothing stopped from outside."""
        if self.ends_run is None:
            return "time over"
        status, kind = open_observer(segment, self.ends_run).peek().value, segment.layout.mailbox(self.ends_run).message
        if status.state != State.ERROR and not self._silence(segment):
            return "task done" if status.state == State.DONE else "time over"
        return "task refused" if kind == TASK_STATUS.name and not status.moves else "task failed"

    def _silence(self, segment: Segment) -> int:
        """Return the ticks since the last status of the level that ends the run; 0: they are not too many."""
        assert self.ends_run is not None, "some level ends the run"
        observer = open_observer(segment, self.ends_run)
        reading = observer.peek()
        if reading.value.state in (State.DONE, State.ERROR):
            return 0
        ticks = segment.words[System.TICK] - (observer.newest if reading.is_there else 0)
        return ticks if ticks > self._silent_ticks else 0

    @property
    def _silent_ticks(self) -> int:
        every = 0 if self.ends_run is None else self.layout.task(self.layout.mailbox(self.ends_run).writer).every
        return max(round(SILENT_S * 1e9 / self.layout.clock_ns), 8 * every)

    def notes(self, segment: Segment) -> list[str]:
        """Return what the launch must say: cores shared out, real-time priority refused."""
        refused = self._refused(segment)
        return shared_out(self.config) + ([f"{refused}; misses are likely. {PERMIT}"] if refused else [])

    def check_realtime(self, segment: Segment) -> None:
        """Raise `LaunchError` when a task was refused its real-time priority and the config does not go on without."""
        if self.config.clock.on_no_realtime == "refuse" and (refused := self._refused(segment)):
            raise LaunchError(f'{refused}, and clock.on_no_realtime is "refuse". {PERMIT}')

    def _refused(self, segment: Segment) -> str:
        refused = [t.name for t in self.layout.tasks if t.priority and not segment.block(t.name)[Block.PRIORITY]]
        return f"SCHED_FIFO refused, ordinary scheduling for {', '.join(refused)}" if refused else ""


def modules(config: RackConfig) -> tuple[str, ...]:
    """Return the modules of all levels, for the crate to import while the config is being checked."""
    targets = [t for board in config.board.values() for t in (board.executor, board.planner) if t]
    return tuple(dict.fromkeys(target.partition(":")[0] for target in targets))


def _task(config: RackConfig, layout: Layout, ports: TaskPorts, fails_self_test: bool) -> TaskWiring:
    board, spec = config.board[ports.board], layout.task(ports.task)
    critical = spec.role == "planner" and is_critical(config, layout, ports.board)
    return TaskWiring(
        task=ports.task,
        target=f"{ports.kind.__module__}:{ports.kind.__qualname__}",
        inputs=dict(ports.reads),
        outputs=dict(ports.writes),
        context=context(config, ports.board),
        poll=(board.wake or config.clock.wake) == "poll" and spec.role == "executor",
        critical_priority=board.priority if critical else 0,
        guards_clock=spec.role == "executor" and spec.every == min(task.every for task in layout.tasks),
        fails_self_test=fails_self_test,
        transfer=Transfer(**{f"{key.removesuffix('_ms')}_ns": round(ms * 1e6) for key, ms in board.transfer}),
    )
