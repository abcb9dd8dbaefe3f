"""One trial: a run of the whole task with its faults, and everything that is needed to judge it."""

from __future__ import annotations

import time
from dataclasses import dataclass

from rack.backplane.errors import BackplaneError
from rack.backplane.layout import Layout
from rack.backplane.words import System
from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.errors import BoardError, ConfigError
from rack.boards.events import Event, Outcome
from rack.tools.campaign.ending import Arm, Strike, arm_of, is_late, levels_of, strikes
from rack.tools.campaign.external import Killer
from rack.tools.campaign.interrupt import Interrupt
from rack.tools.campaign.leftovers import children, left_behind
from rack.tools.campaign.plan import Plan

LONGEST = 4
"""A run with faults may take that many times as long as without, and"""
GRACE_S = 60.0
"""so much simulated time more: behind that it is stopped. Nothing is ever waited for without end."""
NOMINAL_S = 1800.0
"""Simulated time of a run of which nobody knows how long it takes."""
STILL_S = 120.0
"""Time in which a rack must give out a tick; one without faults that plans for longer than this does not end."""
STUCK_S = 20.0
"""Time in which a rack that is told to stop does so."""
RESTART_S = 2.0
"""What a restart takes in real time, at most: a planner with its libraries 1.5 s."""


@dataclass(frozen=True)
class Trial:
    """A trial that was made. `refused` is why the rack did not launch, else empty; `left` what it left behind.

    `levels` tells what state each level was left in, `is_late` that one gave up for a time that it cannot keep.
    `moving` are obstacles that move. `offset_ns` turns CLOCK_MONOTONIC into the events' CLOCK_REALTIME.
    """

    plan: Plan
    layout: Layout | None
    outcome: Outcome | None
    refused: str
    events: tuple[Event, ...]
    strikes: tuple[Strike, ...]
    arm: Arm
    left: tuple[str, ...]
    wall_s: float
    offset_ns: int
    restart_s: float = RESTART_S
    levels: str = ""
    is_late: bool = False
    moving: tuple[str, ...] = ()
    is_interrupted: bool = False


def run_trial(
    config: RackConfig, plan: Plan, rack_name: str, ticks: int, seconds: float | None, interrupt: Interrupt
) -> Trial:
    """Run a plan and take down what came of it.

    `ticks` is the length of a faultless run; `seconds` of simulated time, for a rack that no task ends. Raises
    `ConfigError` for a plan that does not fit the config.
    """
    before, started = children(), time.monotonic()
    rack = Rack(plan.config(config, rack_name))
    refused, levels, late, arm = "", "", False, Arm()
    found: tuple[Strike, ...] = ()
    try:
        with rack:
            killer = Killer(rack.segment, plan.kills)
            _watch(rack, killer, ticks, seconds, interrupt)
            joints = config.robot.joints if config.robot is not None else ()
            found, arm = strikes(rack.segment, joints, killer.done), arm_of(rack.segment)
            levels, late = levels_of(rack.segment), is_late(rack.segment)
    except ConfigError:
        raise
    except (BackplaneError, BoardError) as error:
        refused = str(error)
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
        is_interrupted=interrupt.is_set,
    )


def restart_s(config: RackConfig, lockstep: bool) -> float:
    """Return the simulated time that a restart may take."""
    in_lockstep = config.supervision.lockstep_restart_s
    return in_lockstep if lockstep else max(RESTART_S, in_lockstep)


def _watch(rack: Rack, killer: Killer, ticks: int, seconds: float | None, interrupt: Interrupt) -> None:
    """Watch a run to its end, and kill what is to be killed; no run lasts for ever."""
    rack.start(seconds)
    words = rack.segment.words
    most_s = NOMINAL_S if not ticks else GRACE_S
    most_ticks = LONGEST * ticks + max(most_s, seconds or 0.0) * 1e9 / rack.config.clock_ns
    seen, deadline, stopped = -1, 0.0, False
    while rack.watch(killer.due_in_s()):
        killer.advance()
        if not stopped and (tick := words[System.TICK]) != seen:
            seen, deadline = tick, time.monotonic() + STILL_S
        if not stopped and (why := _why_stop(interrupt, seen > most_ticks, deadline)):
            rack.stop(why)
            stopped, deadline = True, time.monotonic() + STUCK_S
        elif stopped and time.monotonic() > deadline:
            return


def _why_stop(interrupt: Interrupt, too_long: bool, deadline: float) -> str:
    if interrupt.is_set:
        return "the campaign was interrupted"
    return "it takes too long" if too_long or time.monotonic() > deadline else ""
