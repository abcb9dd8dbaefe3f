"""Every board of a rack killed in turn, in one run in lockstep: when the Rack knows, and when a
neighbour does."""

from __future__ import annotations

from dataclasses import dataclass

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import Layout
from rack.boards.config import RackConfig
from rack.boards.faults.config import FaultConfig
from rack.boards.faults.kind import DIED
from rack.tools.faults.evidence import is_about
from rack.tools.lab.benches.kill import KillEvents, run_killing

FIRST_S = 1.0
BETWEEN_S = 1.25
"""Simulated time of the first kill, and between two: a lost board is back after half a second."""


@dataclass(frozen=True)
class KillDetection:
    """One board's kill. `rack` is the ticks until the Rack, which watches processes, knew of its
    end.

    `neighbour` is the ticks until the first board that reads its messages found them stale, `by`
    that board. None: not before the board was back.
    """

    board: str
    rack: int | None
    neighbour: int | None
    by: str


@dataclass(frozen=True)
class KilledBoards:
    """The kills of one run. `tick_ms` is simulated time; `speed` is that of the run, in times real
    time."""

    detections: tuple[KillDetection, ...]
    tick_ms: float
    speed: float
    failure: str

    @property
    def verdict(self) -> str:
        """What was found, in words."""
        seen = sum(kill.neighbour is not None for kill in self.detections)
        return f"{len(self.detections)} killed, {seen} noticed by a neighbour"


def kills_s(layout: Layout) -> float:
    """Return the simulated time that killing everything takes."""
    return FIRST_S + (len(layout.processes) + 1) * BETWEEN_S


def kill_each(config: RackConfig, layout: Layout, share: bool) -> KilledBoards:
    """Run a rack in lockstep, killing each of its processes once, planners, host boards and the
    clock too."""
    names = [*(process.name for process in layout.processes), CLOCK]
    first, between = (round(time_s * 1e9 / config.clock_ns) for time_s in (FIRST_S, BETWEEN_S))
    kills = [
        FaultConfig(kind="kill", board=name, tick=first + at * between)
        for at, name in enumerate(names)
    ]
    killing = config.model_copy(update={"fault": tuple(kills)})
    run = run_killing(killing, kills_s(layout), share)
    end = run.outcome
    return KilledBoards(
        detections=tuple(map(_detection, run.kills)),
        tick_ms=config.clock_ns * 1e-6,
        speed=end.ticks * config.clock_ns / run.lasted_ns,
        failure=end.failure,
    )


def _detection(kill: KillEvents) -> KillDetection:
    strike = kill.strike
    board = strike.board.partition(".")[0]
    died = next((e for e in kill.events if e.kind == DIED and e.board == strike.board), None)
    others = (
        event
        for event in kill.events
        if event.kind == "detection"
        and is_about(event, strike)
        and event.board.partition(".")[0] != board
    )
    first = min(others, key=lambda event: event.tick, default=None)
    by_rack = None if died is None else died.tick - strike.tick
    if first is None:
        return KillDetection(strike.board, by_rack, neighbour=None, by="")
    return KillDetection(strike.board, by_rack, first.tick - strike.tick, first.board)
