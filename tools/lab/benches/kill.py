"""Kills boards of a running rack, and measures when that is detected and when the arm is safe."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from random import Random

from rack.backplane.words import System
from rack.boards import Rack
from rack.boards.config import RackConfig, load
from rack.boards.events import Event
from rack.boards.faults.kind import DIED
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.faults.campaigns.plan import Kill
from rack.tools.faults.campaigns.trial import Killer
from rack.tools.faults.evidence import BRAKES
from rack.tools.lab.benches.harness import Sample
from rack.tools.lab.benches.observed import endless

DETECTED = "detected"
SAFE = "brakes engaged"
KILL_S = 2.5
"""Time between kills: the board is back, and the arm moves again."""
PHASES_S = 0.1
"""Kills are spread over all phases of the slower cycles."""
RUNS = 3
"""Most runs, until as many kills as wanted have been judged."""


def measure_kills(name: str, count: int, progress: Progress) -> Iterator[Sample]:
    """Kill the board that drives the arm, then the one that commands that one, `count` times each;
    yield the times to detection and to engaged brakes.

    Boards are killed under `on_loss = "brake"`: the level below then brakes at once, instead of
    holding.

    Raises:
        Failure: If the rack has no arm, or too few kills had a reaction.
    """
    config = load(name, [f"name=bench-kill-{os.getpid()}", "supervision.restarts=10000"])
    servo = min(config.board, key=config.every)
    above = config.board[servo].above
    if config.robot is None or not above:
        raise Failure(f"{name}: no arm whose brakes could engage", 2)
    random = Random(count)
    for board in (servo, above[0]):
        progress.begin(f"kills of {board}")
        table = config.board[board].model_copy(update={"on_loss": "brake"})
        braking = config.model_copy(update={"board": {**config.board, board: table}})
        found: list[tuple[float, float]] = []
        for _ in range(RUNS):
            if len(found) < count:
                found += _reactions_ms(braking, board, count - len(found), random)
        if len(found) < count:
            raise Failure(f"'{board}' was killed {count} times: {len(found)} reactions")
        progress.end(count * KILL_S)
        for who, times_ms in zip((DETECTED, SAFE), zip(*found, strict=True), strict=True):
            yield Sample(f"{board} killed", who, times_ms, "ms")


def _reactions_ms(
    config: RackConfig, board: str, count: int, random: Random
) -> Iterator[tuple[float, float]]:
    """Yield the times to detection and to engaged brakes, of each kill that engaged them."""
    tick_s = config.clock_ns * 1e-9
    ticks = [(KILL_S * (1 + at) + random.uniform(0.0, PHASES_S)) / tick_s for at in range(count)]
    with Rack(endless(config), share=True) as rack:
        killer = Killer(rack.segment, [Kill(board, int(tick), tick % 1.0) for tick in ticks])
        rack.start(KILL_S * (count + 1))
        while rack.watch(killer.due_in_s()):
            killer.advance()
        events = [event for event in rack.events if event.tick >= 0]
        # From CLOCK_MONOTONIC to the time of events.
        offset_ns = time.time_ns() - time.monotonic_ns()
        epoch_ns = offset_ns + rack.segment.words[System.EPOCH_NS]
    struck = [kill for kill in killer.done if kill.tick >= 0]
    for at, kill in enumerate(struck):
        end = struck[at + 1].tick if at + 1 < len(struck) else float("inf")
        own = [event for event in events if kill.tick <= event.tick < end]
        died, braked = (_first(own, code) for code in (DIED, BRAKES))
        if died is None or braked is None:
            continue
        # A servo level that was away reports the brakes late, with the tick at which they engaged.
        late_ns = epoch_ns + braked.tick * config.clock_ns
        braked_ns = late_ns if braked.value else braked.time_ns
        killed_ns = kill.time_ns + offset_ns
        # On a busy machine they may have engaged for another reason, just before.
        if braked_ns > killed_ns:
            yield (died.time_ns - killed_ns) * 1e-6, (braked_ns - killed_ns) * 1e-6


def _first(events: list[Event], code: str) -> Event | None:
    return next((event for event in events if event.code == code), None)
