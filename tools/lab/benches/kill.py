"""Kills boards of a running rack, and measures when that is detected and when the arm is safe."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from random import Random

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.words import Block, System, TaskState
from rack.boards import Rack
from rack.boards.config import RackConfig, load
from rack.boards.events import Event
from rack.levels.robot.cell import build_cell
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.harness import Sample

DETECTED = "detected"
SAFE = "brakes engaged"
SETTLE_S = 1.0
"""Time between kills, after which the arm moves again."""
PHASES_S = 0.1
"""Kills are spread over all phases of the slower cycles."""
REACT_S = 10.0
"""Longest wait for a reaction, and for the board's return."""
LOOK_S = 0.02


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
        cell = build_cell(config.robot, config.scene, config.clock_ns)
        self._patience = cell.patience.ticks(config.every(servo), config.clock_ns * 1e-9)
        self._random = Random(kills)

    def samples(self, board: str, expected_s: float) -> Iterator[Sample]:
        """Kill a board again and again; yield the times to its detection and to safe torque, in ms
        and in cycles."""
        self._progress.begin(f"kills of {board}")
        found: dict[str, list[float]] = {DETECTED: [], SAFE: []}
        config = self._braking(board)
        seen: list[Event] = []
        with Rack(config, seen.append) as rack:
            rack.start()
            while len(found[SAFE]) < self._kills:
                _watch(rack, SETTLE_S + self._random.uniform(0.0, PHASES_S), lambda: False)
                reaction = self._kill(rack, board, seen)
                # On a busy machine the brakes may have engaged for another reason, just before the
                # kill.
                if reaction[SAFE] > 0.0:
                    for what, seconds in reaction.items():
                        found[what].append(seconds)
            rack.stop("measured")
            while rack.watch(LOOK_S):
                continue
        self._progress.end(self._kills * expected_s)
        cycle_s = config.every(self.boards[0]) * rack.segment.words[System.PERIOD_NS] * 1e-9
        for what, times in found.items():
            yield Sample(f"{board} killed", what, tuple(1e3 * seconds for seconds in times), "ms")
        for what, times in found.items():
            yield Sample(
                f"{board} killed, in cycles",
                what,
                tuple(seconds / cycle_s for seconds in times),
                "cycles",
            )

    def _braking(self, board: str) -> RackConfig:
        """Return the config without an end, in which the loss of this board engages the brakes."""
        boards = {
            name: table.model_copy(update={"ends_run": False})
            for name, table in self._config.board.items()
        }
        boards[board] = boards[board].model_copy(update={"on_loss": "brake"})
        return self._config.model_copy(update={"board": boards})

    def _kill(self, rack: Rack, board: str, seen: list[Event]) -> dict[str, float]:
        """Kill a board and wait until it is back; return the times of the reactions, s."""
        seen.clear()
        block = rack.segment.block(board)
        killed_ns = time.monotonic_ns()
        offset_ns = time.time_ns() - time.monotonic_ns()
        tick = rack.segment.words[System.TICK]
        os.kill(block[Block.PID], signal.SIGKILL)

        def first(code: str) -> Event | None:
            return next(
                (event for event in seen if event.code == code and event.tick >= tick), None
            )

        def is_over() -> bool:
            return (
                bool(first("died") and first("brakes_closed"))
                and block[Block.STATE] == TaskState.RUNNING
            )

        _watch(rack, REACT_S, is_over)
        died = first("died")
        braked = first("brakes_closed")
        if died is None or braked is None:
            raise Failure(f"'{board}' was killed: no reaction within {REACT_S:g} s")
        return {
            DETECTED: (died.time_ns - offset_ns - killed_ns) * 1e-9,
            SAFE: (self._braked_ns(rack, braked, offset_ns) - killed_ns) * 1e-9,
        }

    def _braked_ns(self, rack: Rack, braked: Event, offset_ns: int) -> int:
        """Return when the brakes engaged, CLOCK_MONOTONIC, ns.

        A servo level that was away reports them late: the arm itself engaged them once it had
        waited long enough.
        """
        if not braked.value:
            return braked.time_ns - offset_ns
        return SystemClock(rack.segment).time_of(braked.tick - int(braked.value) + self._patience)


def _watch(rack: Rack, seconds: float, is_over: Callable[[], bool]) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until and not is_over():
        if not rack.watch(LOOK_S):
            raise Failure(f"the rack ended during the measurement: {rack.outcome}")
