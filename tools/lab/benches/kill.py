"""Kills boards of a running rack, and measures when that is detected and when the arm is safe."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator, Sequence
from random import Random
from typing import NamedTuple

from rack.backplane.words import System
from rack.boards import Rack
from rack.boards.config import RackConfig, load
from rack.boards.events import Event, Outcome
from rack.boards.faults.kind import DIED
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.faults.campaigns.plan import Kill
from rack.tools.faults.campaigns.trial import Killer
from rack.tools.faults.ending import Strike, strikes
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


class KillEvents(NamedTuple):
    """A kill, and the events from it until the next one."""

    strike: Strike
    events: tuple[Event, ...]

    def first(self, code: str) -> Event | None:
        """Return the first event of a code."""
        return next((event for event in self.events if event.code == code), None)


class KilledRun(NamedTuple):
    """A run with kills. `offset_ns` turns CLOCK_MONOTONIC into the time of events."""

    kills: tuple[KillEvents, ...]
    outcome: Outcome
    lasted_ns: int
    offset_ns: int
    epoch_ns: int


def run_killing(
    config: RackConfig, seconds: float, share: bool = True, kills: Sequence[Kill] = ()
) -> KilledRun:
    """Run a rack that no board ends, killed by the faults of its config and by `kills` from
    outside."""
    with Rack(endless(config), share=share) as rack:
        killer = Killer(rack.segment, kills)
        rack.start(seconds)
        began_ns = time.monotonic_ns()
        while rack.watch(killer.due_in_s()):
            killer.advance()
        lasted_ns = time.monotonic_ns() - began_ns
        assert rack.outcome is not None, "the run is over"
        injected = (*strikes(rack.segment, ()), *killer.done)
        struck = [strike for strike in injected if strike.tick >= 0]
        ends = [*(strike.tick for strike in struck[1:]), rack.outcome.ticks]
        return KilledRun(
            kills=tuple(
                KillEvents(strike, tuple(e for e in rack.events if strike.tick <= e.tick < end))
                for strike, end in zip(struck, ends, strict=True)
            ),
            outcome=rack.outcome,
            lasted_ns=lasted_ns,
            offset_ns=time.time_ns() - time.monotonic_ns(),
            epoch_ns=rack.segment.words[System.EPOCH_NS],
        )


class Killing:
    """Kills of the boards that matter most to an arm: the one that drives it, and the one that
    commands that one.

    The second is killed under `on_loss = "brake"`: the level below then brakes at once, instead of
    holding.
    """

    def __init__(self, name: str, kills: int, progress: Progress) -> None:
        self._kills = kills
        self._progress = progress
        config = load(name, [f"name=bench-kill-{os.getpid()}", "supervision.restarts=10000"])
        servo = min(config.board, key=config.every)
        above = config.board[servo].above
        if config.robot is None or not above:
            raise Failure(f"{name}: no arm whose brakes could engage", 2)
        self.boards = servo, above[0]
        self._config = config
        self._random = Random(kills)

    def samples(self, board: str) -> Iterator[Sample]:
        """Kill a board again and again; yield the times to its detection and to safe torque, in ms
        and in cycles."""
        self._progress.begin(f"kills of {board}")
        table = self._config.board[board].model_copy(update={"on_loss": "brake"})
        config = self._config.model_copy(update={"board": {**self._config.board, board: table}})
        found: list[tuple[float, float]] = []
        for _ in range(RUNS):
            found += self._reactions_s(config, board, self._kills - len(found))
            if len(found) == self._kills:
                break
        else:
            raise Failure(f"'{board}' was killed {self._kills} times: {len(found)} reactions")
        self._progress.end(self._kills * KILL_S)
        cycle_s = config.every(self.boards[0]) * config.clock_ns * 1e-9
        for case, unit, part_s in (("", "ms", 1e-3), (", in cycles", "cycles", cycle_s)):
            for who, times in zip((DETECTED, SAFE), zip(*found, strict=True), strict=True):
                values = tuple(time_s / part_s for time_s in times)
                yield Sample(f"{board} killed{case}", who, values, unit)

    def _reactions_s(
        self, config: RackConfig, board: str, count: int
    ) -> Iterator[tuple[float, float]]:
        """Yield the times to detection and to engaged brakes, of each kill that engaged them, s."""
        instants = [
            KILL_S * (1 + number) + self._random.uniform(0.0, PHASES_S) for number in range(count)
        ]
        ticks = [second * 1e9 / config.clock_ns for second in instants]
        kills = [Kill(board, int(tick), tick % 1.0) for tick in ticks]
        run = run_killing(config, KILL_S * (count + 1), kills=kills)
        for kill in run.kills:
            died = kill.first(DIED)
            braked = kill.first(BRAKES)
            if died is not None and braked is not None:
                killed_ns = kill.strike.time_ns
                braked_ns = self._braked_ns(run, braked)
                # On a busy machine they may have engaged for another reason, just before.
                if braked_ns > killed_ns:
                    died_ns = died.time_ns - run.offset_ns
                    yield (died_ns - killed_ns) * 1e-9, (braked_ns - killed_ns) * 1e-9

    def _braked_ns(self, run: KilledRun, braked: Event) -> int:
        """Return when the brakes engaged, CLOCK_MONOTONIC, ns.

        A servo level that was away reports them late, with the tick at which they did so.
        """
        if not braked.value:
            return braked.time_ns - run.offset_ns
        return run.epoch_ns + braked.tick * self._config.clock_ns
