"""Levels for tests of boards: a wave scaled by a planner, a level that watches it, and trouble on
request.

A level's parameter `trouble` selects the trouble, `at` its tick and `ticks` its duration.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping
from typing import Any

from rack.backplane.clock.system_clock import SystemClock
from rack.backplane.message import Message, State, Status, field
from rack.backplane.segment import Segment
from rack.backplane.words import Block
from rack.levels.errors import LevelError
from rack.levels.level import Executor, FindingKind, Input, LevelContext, Output, Planner

LONGEST_S = 20.0
"""Bound of a cycle that waits for releases: reached only when something is broken."""


class WaveStatus(Status, version=1, message="wave"):
    """Height of a wave."""

    value: float = field(unit="1", doc="height of the wave")


class Gain(Message, version=1):
    gain: float = field(unit="1", doc="factor")
    made_at: int = field(unit="tick", doc="release")


class Trouble:
    """The trouble that a level makes."""

    def __init__(self, context: LevelContext) -> None:
        params: Mapping[str, Any] = context.params
        self._kind = params.get("trouble", "none")
        self._at = params.get("at", 0)
        self._ticks = params.get("ticks", 0)
        self._took_ns = self._ticks * context.clock_ns
        self._rack, self._board = context.rack, context.board

    def self_test(self) -> None:
        if self._kind == "refuse":
            raise LevelError("the wave is too high: 3 m; permitted: 2 m")
        if self._kind == "leave early":
            os._exit(0)

    def at(self, tick: int) -> None:
        if self._kind == "raise" and tick == self._at:
            raise ValueError(f"no wave at tick {tick}")
        if self._kind == "crash":
            raise RuntimeError("no cycle at all")
        if self._kind == "die" and tick == self._at:
            os.kill(os.getpid(), signal.SIGKILL)
        elif self._kind == "late" and tick >= self._at:
            # Once, in the first cycle from then on: in real time a loaded machine skips some.
            self._kind = "none"
            end = time.monotonic_ns() + self._took_ns
            while time.monotonic_ns() < end:
                pass
        elif self._kind == "outlast" and tick >= self._at:
            self._kind = "none"
            self._outlast(tick + self._ticks)

    def _outlast(self, tick: int) -> None:
        """Compute until the clock has given the release of `tick`, however late the clock is, and
        its time has come."""
        segment = Segment.attach(self._rack)
        clock, block = SystemClock(segment), segment.get_block(self._board)
        end = time.monotonic() + LONGEST_S
        while min(block[Block.RELEASED], clock.compute_tick()) < tick:
            if time.monotonic() > end:
                raise TimeoutError(f"no release of tick {tick} within {LONGEST_S:g} s")


class Wave(Executor):
    """Writes a value that grows with time; done at tick `done_at`."""

    status = Output(WaveStatus)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.trouble = Trouble(context)
        self._done_at = context.params.get("done_at", 1 << 60)
        self._final = State[context.params.get("final", "DONE")]

    def self_test(self) -> None:
        self.trouble.self_test()

    def process(self, tick: int) -> None:
        self.trouble.at(tick)
        self.status.state = self._final if tick >= self._done_at else State.EXECUTING
        self.status.reason = (
            "the tide" if self._final is State.ERROR and tick >= self._done_at else ""
        )
        self.status.value = 0.5 * tick * self.gain()

    def gain(self) -> float:
        return 1.0


class PlannedWave(Wave):
    """A wave scaled by its planner's newest gain."""

    plan = Input(Gain, "own.plan")

    def gain(self) -> float:
        """Return the planned factor; 1 before the first plan."""
        return float(self.plan.message.gain) if self.plan.has_message else 1.0


class Steady(PlannedWave):
    """A planned wave that leaves trouble to its planner."""

    def process(self, tick: int) -> None:
        self.status.state = State.EXECUTING
        self.status.value = 0.5 * tick * self.gain()


class Surf(Wave):
    """Finds a breaking wave in every cycle of the ticks that `breaks` lists."""

    breaker = FindingKind(unit="m", doc="the wave breaks")

    def process(self, tick: int) -> None:
        super().process(tick)
        if tick in self.context.params["breaks"]:
            self.raise_finding("breaker", self.status.value, unit="m", text=f"tick {tick}")


class GainPlanner(Planner):
    """Plans the gain from the wave's status, every `plan_every` ticks."""

    status = Input(WaveStatus, "own.status")
    output = Output(Gain)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.trouble = Trouble(context)
        self._every = context.params.get("plan_every", 1)

    def wanted(self, tick: int) -> bool:
        return tick % self._every == 0

    def plan(self, tick: int) -> None:
        self.trouble.at(tick)
        self.output.gain = 1.0 + 1.0 / (1.0 + abs(self.status.message.value))
        self.output.made_at = tick


class BadPlanner(GainPlanner):
    """A planner that fails its self-test."""

    def self_test(self) -> None:
        raise LevelError("no gain is known: 0 of 3")


class Watch(Executor):
    """Repeats the wave's status."""

    below = Input(WaveStatus, "below.status")
    status = Output(WaveStatus, rests_on=below)

    def process(self, tick: int) -> None:
        self.status.state = self.below.message.state
        self.status.reason = self.below.message.reason
        self.status.value = self.below.message.value


class Endless(Watch):
    """A level whose self-test does not end."""

    def self_test(self) -> None:
        while True:
            time.sleep(1)


class Preloaded(Watch):
    """A level that fails its self-test with the processes in which it was preloaded, and that
    forked it."""

    preloaded_in: list[int] = []

    @classmethod
    def preload(cls) -> None:
        cls.preloaded_in.append(os.getpid())

    def self_test(self) -> None:
        raise LevelError(f"preloaded in {self.preloaded_in}, forked by [{os.getppid()}]")


class Unpreloadable(Watch):
    """A level that cannot be preloaded."""

    @classmethod
    def preload(cls) -> None:
        raise OSError("no room for\ncompiled code")


class SlowlyPreloaded(Watch):
    """A level that is preloaded once another process opens the FIFO named by the variable
    WAVE_MAY_LOAD."""

    @classmethod
    def preload(cls) -> None:
        os.close(os.open(os.environ["WAVE_MAY_LOAD"], os.O_RDONLY))


class Lottery(Wave):
    """A wave that differs from process to process."""

    def process(self, tick: int) -> None:
        super().process(tick)
        self.status.value = float(os.getpid())
