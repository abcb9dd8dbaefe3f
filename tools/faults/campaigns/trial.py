"""One trial: a run of the whole task with faults, and the data for its evaluation."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence, Set
from contextlib import suppress
from dataclasses import dataclass, field, replace

from rack.backplane.address_map import CLOCK
from rack.backplane.errors import BackplaneError
from rack.backplane.layout import Layout
from rack.backplane.message import State, format_state, get_reason
from rack.backplane.process import is_alive
from rack.backplane.segment import Segment
from rack.backplane.words import Block, System, TaskState
from rack.boards import Rack
from rack.boards.config import resolve_layout
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import WarmCrate
from rack.boards.errors import BoardError, ConfigError
from rack.boards.events import OF_LAUNCH, Event, Outcome, iterate_statuses
from rack.boards.faults.bounds import list_affected_mailboxes
from rack.boards.wiring import Continuation, SnapshotPolicy
from rack.levels.messages import Error
from rack.tools.faults.campaigns.environment import find_leftovers, list_living_descendants
from rack.tools.faults.campaigns.outages import count_missing_messages
from rack.tools.faults.campaigns.pacer import Pacer
from rack.tools.faults.campaigns.plan import Kill, Plan
from rack.tools.faults.ending import EXTERNAL, ArmEnd, Strike, list_strikes, read_arm
from rack.tools.faults.judge import Circumstances

MAX_LENGTH_FACTOR = 4
GRACE_S = 60.0
"""A run is stopped after `MAX_LENGTH_FACTOR` times a faultless run's length plus `GRACE_S`."""
NOMINAL_S = 1800.0
"""Simulated time allowed for a run whose length is unknown."""
STILL_S = 120.0
"""Maximum real time in s without a tick. No rack plans for longer."""
STUCK_S = 20.0
"""Maximum real time in s that a run may take to end after a request to stop."""
LOOK_S = 0.001
"""Shortest interval at which the tick is checked, and the interval in lockstep."""


class Killer:
    """Kills boards of one rack with SIGKILL at given times, without the fault table.

    Attributes:
        done: The kills so far.
    """

    def __init__(self, segment: Segment, kills: Sequence[Kill]) -> None:
        self._segment = segment
        self._words = segment.words
        self._waiting = list(kills)
        self.done: list[Strike] = []

    def compute_wait_s(self) -> float:
        """Return the time in s until the next kill is due, at most 0.5."""
        if not self._waiting:
            return 0.5
        words = self._words
        left_s = (self._waiting[0].tick - words[System.TICK]) * words[System.PERIOD_NS] * 1e-9
        return LOOK_S if words[System.LOCKSTEP] else min(0.5, max(LOOK_S, left_s))

    def kill_due_board(self) -> None:
        """Kill the next board if its kill is due. If it is not running, the next call tries again.

        The phase varies what the board is doing when it is killed.
        """
        if self._waiting and self._words[System.TICK] >= self._waiting[0].tick:
            kill = self._waiting[0]
            time.sleep(kill.phase * self._words[System.PERIOD_NS] * 1e-9)
            if self._kill_board(kill.board):
                self._waiting.pop(0)

    def _kill_board(self, board: str) -> bool:
        """Kill a board and record the kill. Return False if the board is not running."""
        pid = self._find_pid(board)
        if not is_alive(pid):
            return False
        tick = self._words[System.TICK]
        kill = build_external_kill(self._segment.layout, board, tick, time.monotonic_ns())
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
            self.done.append(kill)
            return True
        return False

    def _find_pid(self, board: str) -> int:
        """Return the process id of a running board, or 0 if the board is not running."""
        if board == CLOCK:
            return self._words[System.CLOCK_PID]
        block = self._segment.get_block(board)
        is_up = block[Block.STATE] == TaskState.RUNNING and not block[Block.LOST]
        return block[Block.PID] if is_up else 0


def build_external_kill(layout: Layout, board: str, tick: int, time_ns: int) -> Strike:
    """Return an external kill in the form of a recorded fault.

    Args:
        layout: Layout of the rack.
        board: Board that was killed.
        tick: Tick of the kill.
        time_ns: CLOCK_MONOTONIC of the kill in ns.
    """
    return Strike(
        fault=-1,
        kind=EXTERNAL,
        board=board,
        began=tick,
        ends=tick,
        tick=tick,
        time_ns=time_ns,
        mailboxes=tuple(box.name for box in list_affected_mailboxes(layout, -1, board)),
    )


@dataclass(frozen=True)
class Start:
    """Starting point of a trial.

    Attributes:
        tick: Tick before which the trial starts.
        whole: Why the trial does not continue from a snapshot. Empty if it does, and for the
            faultless run.
        continues: The snapshot from which to continue. None for a whole run.
        snapshots: When the trial takes snapshots. None for no snapshots.
        events: Events of the faultless run that the trial continues.
    """

    tick: int = 0
    whole: str = ""
    continues: Continuation | None = None
    snapshots: SnapshotPolicy | None = None
    events: tuple[Event, ...] = ()


@dataclass
class Trial:
    """A trial that was run.

    Attributes:
        plan: Plan of the trial.
        run: Facts about the run for its evaluation. None if the launch was refused.
        outcome: Outcome of the run.
        refused: Why the rack did not launch. Empty if it did.
        events: Events of the whole run, including those before the `start`.
        strikes: Faults of the run.
        arm: State of the arm at the end.
        left: Everything that the rack left behind.
        wall_s: Duration in s of real time.
        levels: Last state of each level, as text.
        is_late: Whether a level ended with an error because it could not meet a time.
        again: Outcome of a second run, without the faults, after a refused launch.
        begin_ticks: Tick at which each fault of the plan began, or was due when the run ended.
        start: Starting point of the trial.
        missing: Number of messages that the boards of its faults have not written.
        is_cut: Whether the trial was ended early because the verdict on each fault was certain.
    """

    plan: Plan
    run: Circumstances | None = None
    outcome: Outcome | None = None
    refused: str = ""
    events: tuple[Event, ...] = ()
    strikes: tuple[Strike, ...] = ()
    arm: ArmEnd = field(default_factory=ArmEnd)
    left: tuple[str, ...] = ()
    wall_s: float = 0.0
    levels: str = ""
    is_late: bool = False
    again: Outcome | None = None
    begin_ticks: tuple[int, ...] = ()
    start: Start = field(default_factory=Start)
    missing: int = 0
    is_cut: bool = False


def run_trial(
    config: RackConfig,
    plan: Plan,
    rack_name: str,
    ticks: int,
    seconds: float | None,
    *,
    start: Start = Start(),
    crate: WarmCrate | None = None,
    cores: Set[int] = frozenset(),
) -> Trial:
    """Run a plan and return the data for its evaluation.

    In a trial that continues from a snapshot, each fault begins as soon as the ones before it are
    settled, but not after its planned tick. The trial ends as soon as all verdicts are certain.

    Args:
        config: Config of the rack, without faults.
        plan: Plan of the trial.
        rack_name: Name of the rack.
        ticks: Length of a faultless run in ticks. 0 if unknown.
        seconds: Simulated time in s after which the run ends if no task ends it.
        start: Starting point of the trial.
        crate: Crate that runs the rack and has the snapshots. None to start a new one.
        cores: Cores on which the boards may run. Empty for the cores of the config.

    Raises:
        ConfigError: The plan does not fit the config.
    """
    trial = Trial(plan)
    pids_before = list_living_descendants()
    started = time.monotonic()
    rack = Rack(
        plan.to_config(config, rack_name),
        crate=crate,
        snapshots=start.snapshots,
        continues=start.continues,
    )
    try:
        with rack:
            begin = max(0, rack.begins_at)
            start = replace(start, tick=begin)
            rack.events.extend(
                event
                for event in start.events
                if event.tick < begin and event.kind not in (*OF_LAUNCH, "end")
            )
            _move_boards(rack.segment, cores)
            killer = Killer(rack.segment, plan.kills)
            joints = config.robot.joints if config.robot is not None else ()
            pacer = None
            if start.continues is not None and plan.faults and not plan.kills:
                pacer = Pacer(rack, joints, _collect_circumstances(rack, plan), plan.faults)
            _watch_run(rack, killer, ticks, seconds, pacer)
            trial.is_cut = pacer is not None and pacer.is_over
            trial.strikes = (*list_strikes(rack.segment, joints), *killer.done)
            find_board = rack.segment.layout.find_first_copy
            boards = {find_board(strike.board) for strike in trial.strikes}
            trial.missing = count_missing_messages(rack.segment, boards, rack.events)
            if pacer is not None:
                trial.begin_ticks = pacer.begin_ticks
            trial.arm = read_arm(rack.segment)
            trial.levels = format_levels(rack.segment)
            trial.is_late = is_late(rack.segment)
    except ConfigError:
        raise
    except (BackplaneError, BoardError) as error:
        trial.refused = str(error)
    if not trial.refused:
        trial.run = _collect_circumstances(rack, plan)
    elif plan.faults:
        faultless = replace(plan, faults=())
        # Run until each task has begun a cycle.
        last_begin = max(task.phase for task in resolve_layout(config).tasks)
        rerun_s = (last_begin + 1) * config.clock_ns * 1e-9
        trial.again = run_trial(config, faultless, rack_name, ticks, rerun_s, crate=crate).outcome
    trial.start = start
    trial.outcome = rack.outcome
    trial.events = tuple(sorted(rack.events, key=lambda event: event.tick))
    trial.left = tuple(find_leftovers(rack_name, pids_before))
    trial.wall_s = time.monotonic() - started
    return trial


def format_levels(segment: Segment) -> str:
    """Return a text with the last state of each level and the reason for it."""
    states = []
    for writer, status in iterate_statuses(segment, "state"):
        reason = f" ({why})" if (why := get_reason(status)) else ""
        states.append(f"{writer} {format_state(status.state)}{reason}")
    return ", ".join(states)


def is_late(segment: Segment) -> bool:
    """Return True if a level ended with an error because it could not meet a deadline."""
    return any(
        status.state == State.ERROR and status.error == Error.TOO_LATE
        for _, status in iterate_statuses(segment, "error")
    )


def _collect_circumstances(rack: Rack, plan: Plan) -> Circumstances:
    """Collect the facts about a run for the evaluation of its faults."""
    config = rack.config
    return Circumstances(
        layout=rack.segment.layout,
        offset_ns=time.time_ns() - time.monotonic_ns(),
        is_lockstep=plan.lockstep,
        restart_s=config.supervision.find_restart_time(plan.lockstep),
        has_failed=rack.outcome is not None and not rack.outcome.is_success,
        moving=tuple(motion.body for motion in config.scene.motion),
    )


def _move_boards(segment: Segment, cores: Set[int]) -> None:
    """Let the boards of a launched rack run on any of these cores."""
    blocks = (segment.get_block(task.name) for task in segment.layout.tasks)
    for pid in (segment.words[System.CLOCK_PID], *(block[Block.PID] for block in blocks)):
        with suppress(ProcessLookupError):
            if pid and cores:
                os.sched_setaffinity(pid, cores)


def _watch_run(
    rack: Rack, killer: Killer, ticks: int, seconds: float | None, pacer: Pacer | None
) -> None:
    """Start the run and watch it to its end. Kill boards as planned.

    The run is stopped if it takes too long, or ended early if `pacer` does so.
    """
    rack.start(seconds)
    words = rack.segment.words
    extra_s = GRACE_S if ticks else NOMINAL_S
    max_ticks = (
        MAX_LENGTH_FACTOR * ticks + max(extra_s, seconds or 0.0) * 1e9 / rack.config.clock_ns
    )
    last_tick = -1
    deadline = 0.0
    stopped = False
    while rack.watch(killer.compute_wait_s()):
        killer.kill_due_board()
        if pacer is not None:
            pacer.continue_if_held()
        now_s = time.monotonic()
        if stopped and now_s > deadline:
            return
        if not stopped and words[System.TICK] != last_tick:
            last_tick = words[System.TICK]
            deadline = now_s + STILL_S
        if not stopped and (now_s > deadline or last_tick > max_ticks):
            rack.stop("the trial takes too long")
            stopped = True
            deadline = now_s + STUCK_S
