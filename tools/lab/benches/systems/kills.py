"""Every board of a rack killed in turn, in one run in lockstep: when the Rack knows, and when a
neighbour does."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import Layout
from rack.boards import Rack
from rack.boards.config import RackConfig
from rack.boards.events import Event
from rack.boards.faults.config import FaultConfig
from rack.boards.faults.kind import DIED
from rack.tools.faults.ending import Strike, strikes
from rack.tools.faults.evidence import is_about

FIRST_S = 1.0
BETWEEN_S = 1.25
"""Simulated time of the first kill, and between two: a lost board is back after half a second."""
LOOK_S = 0.05


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
    boards = {
        name: board.model_copy(update={"ends_run": False}) for name, board in config.board.items()
    }
    killing = config.model_copy(update={"board": boards, "fault": tuple(kills)})
    seen: list[Event] = []
    with Rack(killing, seen.append, share) as rack:
        rack.start(kills_s(layout))
        began_ns = time.monotonic_ns()
        while rack.watch(LOOK_S):
            continue
        assert rack.outcome is not None, "the run is over"
        struck = [
            strike
            for strike in strikes(rack.segment, (), ())
            if strike.kind == "kill" and strike.tick >= 0
        ]
        outcome = rack.outcome
        lasted_ns = time.monotonic_ns() - began_ns
    return KilledBoards(
        detections=tuple(_detection(strike, seen, between) for strike in struck),
        tick_ms=config.clock_ns * 1e-6,
        speed=outcome.ticks * config.clock_ns / lasted_ns,
        failure=""
        if outcome.worked
        else f"{outcome.cause}: {'; '.join(outcome.faults) or outcome.reason}",
    )


def _detection(strike: Strike, seen: Sequence[Event], until: int) -> KillDetection:
    after = [event for event in seen if strike.tick <= event.tick < strike.tick + until]
    ends = [event.tick for event in after if event.kind == DIED and event.board == strike.board]
    found = [event for event in after if event.kind == "detection" and is_about(event, strike)]
    others = [
        event for event in found if event.board.partition(".")[0] != strike.board.partition(".")[0]
    ]
    first = min(others, key=lambda event: event.tick, default=None)
    return KillDetection(
        board=strike.board,
        rack=min(ends) - strike.tick if ends else None,
        neighbour=None if first is None else first.tick - strike.tick,
        by="" if first is None else first.board,
    )
