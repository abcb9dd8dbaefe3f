"""One trial: a run of the whole task with its faults, and everything that its judgement needs."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

from rack.backplane.address_map import CLOCK
from rack.backplane.errors import BackplaneError
from rack.backplane.layout import Layout
from rack.backplane.message import State, reason_of, state_name
from rack.backplane.process import is_alive
from rack.backplane.segment import Segment
from rack.backplane.words import Block, System, TaskState
from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import WarmCrate
from rack.boards.errors import BoardError, ConfigError
from rack.boards.events import Event, Outcome, statuses
from rack.boards.faults.bounds import struck_mailboxes
from rack.levels.messages import Error
from rack.tools.faults.campaigns.base import BaseRack, Start
from rack.tools.faults.campaigns.certainty import Certainty
from rack.tools.faults.campaigns.environment import children, left_behind
from rack.tools.faults.campaigns.plan import Kill, Plan
from rack.tools.faults.ending import EXTERNAL, ArmEnd, Strike, arm_of, strikes
from rack.tools.faults.judge import Circumstances

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
LOOK_S = 0.001
"""Time between two looks at the tick in lockstep, which has no grid to sleep on."""
HELD_S = 0.004
"""Time between two looks at a rack that may be held."""
AGAIN_S = 2.0
"""Simulated time of the run that follows a refused launch: each task has its cycles."""
RETRY_S = 0.02
"""Time after which a kill is tried again where the board is being restarted."""


class Killer:
    """Kills boards of one rack by SIGKILL, at their instants, without the fault table. `done` are
    the kills so far.
    """

    def __init__(self, segment: Segment, kills: Sequence[Kill]) -> None:
        self._segment = segment
        self._words = segment.words
        self._waiting = list(kills)
        self._retry_at = 0.0
        self.done: list[Strike] = []

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
        words = self._words
        if not self._waiting or time.monotonic() < self._retry_at:
            return
        kill = self._waiting[0]
        if words[System.TICK] < kill.tick:
            return
        wait_ns = self._instant_ns() - time.monotonic_ns()
        if words[System.LOCKSTEP]:
            # Here the phase only spreads kills over what boards do in their ticks.
            wait_ns = round(kill.phase * words[System.PERIOD_NS])
        time.sleep(max(0, wait_ns) * 1e-9)
        if self._kill(kill.board):
            self._waiting.pop(0)
        else:
            self._retry_at = time.monotonic() + RETRY_S

    def _instant_ns(self) -> int:
        kill = self._waiting[0]
        words = self._words
        return words[System.EPOCH_NS] + round((kill.tick + kill.phase) * words[System.PERIOD_NS])

    def _kill(self, board: str) -> bool:
        pid = self._pid(board)
        if not is_alive(pid):
            return False
        tick = self._words[System.TICK]
        kill = kill_from_outside(self._segment.layout, board, tick, time.monotonic_ns())
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
            self.done.append(kill)
            return True
        return False

    def _pid(self, board: str) -> int:
        """Return the process of a board that is running; 0 for another."""
        if board == CLOCK:
            return self._words[System.CLOCK_PID]
        block = self._segment.block(board)
        is_up = block[Block.STATE] == TaskState.RUNNING and not block[Block.LOST]
        return block[Block.PID] if is_up else 0


def kill_from_outside(layout: Layout, board: str, tick: int, time_ns: int) -> Strike:
    """Return the kill of a board at `tick` and at CLOCK_MONOTONIC `time_ns`."""
    return Strike(
        fault=-1,
        kind=EXTERNAL,
        board=board,
        began=tick,
        ends=tick,
        tick=tick,
        time_ns=time_ns,
        mailboxes=tuple(box.name for box in struck_mailboxes(layout, -1, board)),
    )


@dataclass(frozen=True)
class Trial:
    """A trial that was made. `refused` is the reason why the rack did not launch, else empty.

    `again`: how a run without its faults ended, right after it was refused. `left` is everything
    that it left behind. `levels` holds the last state of each level; `is_late`: one gave up because
    it could not meet a time. `run`: what the judge must know of it; None where it was refused.
    `events` are those of a whole run, wherever it has its `start`. `is_cut`: it was ended when the
    verdict on each of its faults was certain.
    """

    plan: Plan
    run: Circumstances | None
    outcome: Outcome | None
    refused: str
    events: tuple[Event, ...]
    strikes: tuple[Strike, ...]
    arm: ArmEnd
    left: tuple[str, ...]
    wall_s: float
    levels: str = ""
    is_late: bool = False
    again: Outcome | None = None
    start: Start = field(default_factory=Start)
    is_cut: bool = False


def run_trial(
    config: RackConfig,
    plan: Plan,
    rack_name: str,
    ticks: int,
    seconds: float | None,
    *,
    base: BaseRack | None = None,
    crate: WarmCrate | None = None,
) -> Trial:
    """Run a plan, and return its outcome, events and strikes.

    `ticks` is the length of a faultless run; `seconds` of simulated time, for a rack that no task
    ends. It goes on from a snapshot of `base` if it can, which is in that `crate`, and then ends as
    soon as the verdict on each of its faults is certain.
    Raises `ConfigError` for a plan that does not fit the config.
    """
    start = Start(whole="as asked") if base is None else base.start_of(plan, crate, seconds)
    before = children()
    started = time.monotonic()
    rack = Rack(plan.config(config, rack_name), crate=crate, continues=start.continues)
    refused = ""
    is_cut = False
    levels = ""
    late = False
    arm = ArmEnd()
    found: tuple[Strike, ...] = ()
    try:
        with rack:
            start = start.at(rack.begins_at)
            rack.follow(start.events)
            killer = Killer(rack.segment, plan.kills)
            joints = config.robot.joints if config.robot is not None else ()
            certainty = None
            if start.continues is not None and not plan.kills:
                certainty = Certainty(rack, joints, _circumstances(rack, plan))
            _watch(rack, killer, ticks, seconds, certainty)
            is_cut = certainty is not None and certainty.is_reached
            found = (*strikes(rack.segment, joints), *killer.done)
            arm = arm_of(rack.segment)
            levels = levels_of(rack.segment)
            late = is_late(rack.segment)
    except ConfigError:
        raise
    except (BackplaneError, BoardError) as error:
        refused = str(error)
    again = None
    run = None
    if not refused:
        run = _circumstances(rack, plan)
    elif plan.faults:
        sound = replace(plan, faults=())
        again = run_trial(config, sound, rack_name, ticks, AGAIN_S, crate=crate).outcome
    return Trial(
        plan=plan,
        run=run,
        outcome=rack.outcome,
        refused=refused,
        events=tuple(sorted(rack.events, key=lambda event: event.tick)),
        strikes=found,
        arm=arm,
        left=tuple(left_behind(rack_name, before)),
        wall_s=time.monotonic() - started,
        levels=levels,
        is_late=late,
        again=again,
        start=start,
        is_cut=is_cut,
    )


def levels_of(segment: Segment) -> str:
    """Return the last state of each level, with its reason, as one readable text."""
    states = []
    for writer, status in statuses(segment, "state"):
        reason = f" ({why})" if (why := reason_of(status)) else ""
        states.append(f"{writer} {state_name(status.state)}{reason}")
    return ", ".join(states)


def is_late(segment: Segment) -> bool:
    """Return whether a level gave up because it cannot meet a time."""
    return any(
        s.state == State.ERROR and s.error == Error.TOO_LATE for _, s in statuses(segment, "error")
    )


def _circumstances(rack: Rack, plan: Plan) -> Circumstances:
    """Return what the judge must know of a run."""
    config = rack.config
    return Circumstances(
        layout=rack.segment.layout,
        offset_ns=time.time_ns() - time.monotonic_ns(),
        is_lockstep=plan.lockstep,
        restart_s=config.supervision.restart_s(plan.lockstep),
        has_failed=rack.outcome is not None and not rack.outcome.worked,
        moving=tuple(motion.body for motion in config.scene.motion),
    )


def _watch(
    rack: Rack, killer: Killer, ticks: int, seconds: float | None, certainty: Certainty | None
) -> None:
    """Watch a run to its end, and kill its boards as planned; no run lasts for ever."""
    rack.start(seconds)
    words = rack.segment.words
    most_s = GRACE_S if ticks else NOMINAL_S
    most_ticks = MAX_LENGTH * ticks + max(most_s, seconds or 0.0) * 1e9 / rack.config.clock_ns
    seen = -1
    deadline = 0.0
    stopped = False
    while rack.watch(killer.due_in_s() if certainty is None else HELD_S):
        killer.advance()
        if certainty is not None:
            certainty.look()
        now = time.monotonic()
        if stopped and now > deadline:
            return
        if not stopped and words[System.TICK] != seen:
            seen = words[System.TICK]
            deadline = now + STILL_S
        if not stopped and (now > deadline or seen > most_ticks):
            rack.stop("the trial takes too long")
            stopped = True
            deadline = now + STUCK_S
