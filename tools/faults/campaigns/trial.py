"""One trial: a run of the whole task with its faults, and everything that its judgement needs."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

from rack.backplane.address_map import CLOCK
from rack.backplane.errors import BackplaneError
from rack.backplane.layout import Layout
from rack.backplane.process import is_alive, start_time
from rack.backplane.segment import Segment
from rack.backplane.words import Block, System, TaskState
from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.errors import BoardError, ConfigError
from rack.boards.events import Event, Outcome
from rack.tools.faults.campaigns.environment import children, left_behind
from rack.tools.faults.campaigns.plan import Kill, Plan
from rack.tools.faults.ending import ArmEnd, Killed, Strike, arm_of, is_late, levels_of, strikes

MAX_LENGTH = 4
GRACE_S = 60.0
"""A run with faults is stopped after this multiple of a faultless run's length, and this simulated
time more."""
NOMINAL_S = 1800.0
"""Simulated time of a run whose length is unknown."""
STILL_S = 120.0
"""Longest time without a tick: no rack plans for longer."""
STUCK_S = 20.0
"""Longest time from a request to stop to the end."""
RESTART_S = 2.0
"""Longest time of a restart in real time: a planner with its libraries takes 1.5 s."""
LOOK_S = 0.001
"""Time between two looks at the tick in lockstep, which has no grid to sleep on."""
AGAIN_S = 2.0
"""Simulated time of the run that follows a refused launch: each task has its cycles."""
RETRY_S = 0.02
"""Time after which a kill is tried again where the board is being restarted."""


class Killer:
    """Kills boards of one rack by SIGKILL, at their instants, without the fault table. `done` are
    the kills so far."""

    def __init__(self, segment: Segment, kills: Sequence[Kill]) -> None:
        self._segment = segment
        self._words = segment.words
        self._waiting = list(kills)
        self._retry_at = 0.0
        self.done: list[Killed] = []

    def due_in_s(self) -> float:
        """Return the time until the next kill, at most half a second."""
        if not self._waiting:
            return 0.5
        if self._words[System.LOCKSTEP]:
            return LOOK_S
        at = max(self._instant_ns() * 1e-9, self._retry_at)
        return min(0.5, max(0.0, at - time.monotonic()))

    def advance(self) -> None:
        """Kill the board whose instant has come; one that is not running, as soon as it is."""
        if (
            not self._waiting
            or self._words[System.TICK] < self._waiting[0].tick
            or time.monotonic() < self._retry_at
        ):
            return
        self._await_phase()
        kill = self._waiting[0]
        if self._kill(kill.board):
            self._waiting.pop(0)
        else:
            self._retry_at = time.monotonic() + RETRY_S

    def _await_phase(self) -> None:
        # In lockstep the phase only spreads kills over what boards do in their ticks.
        kill = self._waiting[0]
        period = self._words[System.PERIOD_NS]
        lockstep = self._words[System.LOCKSTEP]
        until = time.monotonic_ns() + round(kill.phase * period) if lockstep else self._instant_ns()
        time.sleep(max(0, until - time.monotonic_ns()) * 1e-9)

    def _instant_ns(self) -> int:
        kill = self._waiting[0]
        words = self._words
        return words[System.EPOCH_NS] + round((kill.tick + kill.phase) * words[System.PERIOD_NS])

    def _kill(self, board: str) -> bool:
        pid, is_up = self._process(board)
        if not is_up or not is_alive(pid):
            return False
        started = start_time(pid)
        with suppress(ProcessLookupError):
            descriptor = os.pidfd_open(pid)
            try:
                # The number may have become another process's between the two looks.
                if (pid, True) == self._process(board) and is_alive(pid, started):
                    tick = self._words[System.TICK]
                    now = time.monotonic_ns()
                    signal.pidfd_send_signal(descriptor, signal.SIGKILL)
                    self.done.append(Killed(board, tick, now))
                    return True
            finally:
                os.close(descriptor)
        return False

    def _process(self, board: str) -> tuple[int, bool]:
        """Return a board's process, and whether it is running."""
        if board == CLOCK:
            return self._words[System.CLOCK_PID], True
        block = self._segment.block(board)
        return block[Block.PID], block[Block.STATE] == TaskState.RUNNING and not block[Block.LOST]


@dataclass(frozen=True)
class Trial:
    """A trial that was made. `refused` is the reason why the rack did not launch, else empty.

    `again`: how a run without its faults ended, right after it was refused. `left` is everything
    that it left behind. `levels` holds the last state of each level; `is_late`: one gave up because
    it could not meet a time. `moving` are obstacles that move. `offset_ns` turns CLOCK_MONOTONIC
    into the events' CLOCK_REALTIME.
    """

    plan: Plan
    layout: Layout | None
    outcome: Outcome | None
    refused: str
    events: tuple[Event, ...]
    strikes: tuple[Strike, ...]
    arm: ArmEnd
    left: tuple[str, ...]
    wall_s: float
    offset_ns: int
    restart_s: float = RESTART_S
    levels: str = ""
    is_late: bool = False
    moving: tuple[str, ...] = ()
    again: Outcome | None = None


def run_trial(
    config: RackConfig, plan: Plan, rack_name: str, ticks: int, seconds: float | None
) -> Trial:
    """Run a plan, and return its outcome, events and strikes.

    `ticks` is the length of a faultless run; `seconds` of simulated time, for a rack that no task
    ends. Raises `ConfigError` for a plan that does not fit the config.
    """
    before = children()
    started = time.monotonic()
    rack = Rack(plan.config(config, rack_name))
    refused = ""
    levels = ""
    late = False
    arm = ArmEnd()
    found: tuple[Strike, ...] = ()
    try:
        with rack:
            killer = Killer(rack.segment, plan.kills)
            _watch(rack, killer, ticks, seconds)
            joints = config.robot.joints if config.robot is not None else ()
            found = strikes(rack.segment, joints, killer.done)
            arm = arm_of(rack.segment)
            levels = levels_of(rack.segment)
            late = is_late(rack.segment)
    except ConfigError:
        raise
    except (BackplaneError, BoardError) as error:
        refused = str(error)
    again = None
    if refused and plan.faults:
        again = run_trial(config, replace(plan, faults=()), rack_name, ticks, AGAIN_S).outcome
    return Trial(
        plan=plan,
        layout=rack.segment.layout if hasattr(rack, "segment") else None,
        outcome=rack.outcome,
        refused=refused,
        events=tuple(rack.events),
        strikes=found,
        arm=arm,
        left=tuple(left_behind(rack_name, before)),
        wall_s=time.monotonic() - started,
        offset_ns=time.time_ns() - time.monotonic_ns(),
        restart_s=restart_s(config, plan.lockstep),
        levels=levels,
        is_late=late,
        moving=tuple(motion.body for motion in config.scene.motion),
        again=again,
    )


def restart_s(config: RackConfig, lockstep: bool) -> float:
    """Return the simulated time that a restart may take."""
    in_lockstep = config.supervision.lockstep_restart_s
    return in_lockstep if lockstep else max(RESTART_S, in_lockstep)


def _watch(rack: Rack, killer: Killer, ticks: int, seconds: float | None) -> None:
    """Watch a run to its end, and kill its boards as planned; no run lasts for ever."""
    rack.start(seconds)
    words = rack.segment.words
    most_s = NOMINAL_S if not ticks else GRACE_S
    most_ticks = MAX_LENGTH * ticks + max(most_s, seconds or 0.0) * 1e9 / rack.config.clock_ns
    seen = -1
    deadline = 0.0
    stopped = False
    while rack.watch(killer.due_in_s()):
        killer.advance()
        if not stopped and (tick := words[System.TICK]) != seen:
            seen = tick
            deadline = time.monotonic() + STILL_S
        if not stopped and (why := _why_stop(seen > most_ticks, deadline)):
            rack.stop(why)
            stopped = True
            deadline = time.monotonic() + STUCK_S
        elif stopped and time.monotonic() > deadline:
            return


def _why_stop(too_long: bool, deadline: float) -> str:
    return "the trial takes too long" if too_long or time.monotonic() > deadline else ""
