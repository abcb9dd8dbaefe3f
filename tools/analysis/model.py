"""What the equations need to know of a rack beside its times."""

from __future__ import annotations

from dataclasses import dataclass

from rack.backplane.layout import Layout, TaskSpec
from rack.boards.config.schema import RackConfig
from rack.boards.config.timing import NS_PER_MS, is_critical, tick_ns
from rack.tools.timing.prediction import hierarchy, longest_cycles


@dataclass(frozen=True)
class Model:
    """A rack as the equations see it. `tick_ns` is one tick of the wall clock; in lockstep, of simulated time.

    `levels` are the boards of the hierarchy; `cycles` and `longest_cycles` (R_max) are ticks. Of boards with a planner
    `tight` are those that share their processor with it, and `critical` those of them that it may keep waiting while
    it updates the plan.
    """

    is_lockstep: bool
    tick_ns: int
    cycles: dict[str, int]
    longest_cycles: dict[str, float]
    levels: tuple[str, ...]
    tight: frozenset[str]
    critical: frozenset[str]
    switch_ns: float
    small_share: float

    @classmethod
    def of(cls, config: RackConfig, layout: Layout) -> Model:
        """Return the model of a config and its layout."""
        tight = frozenset(name for name, board in config.board.items() if board.coupling == "tight")
        return cls(
            is_lockstep=config.clock.mode == "lockstep",
            tick_ns=tick_ns(config),
            cycles={name: layout.task(name).every for name in config.board},
            longest_cycles=longest_cycles(config),
            levels=hierarchy(config),
            tight=tight,
            critical=frozenset(name for name in tight if is_critical(config, layout, name)),
            switch_ns=config.timing.context_switch_ms * NS_PER_MS,
            small_share=config.timing.small_share,
        )

    def cycle_ns(self, task: TaskSpec) -> int:
        """R_i of the level that a task belongs to."""
        return self.cycles[task.board] * self.tick_ns

    def slice_ns(self, task: TaskSpec) -> int:
        """The time that one of its cycles has: a planner's, d R_i, is its time slice."""
        return task.every * task.within_cycles * self.tick_ns

    def longest_cycle_ns(self, task: TaskSpec) -> int:
        """R_max of eq. 3.4."""
        return round(self.longest_cycles[task.board] * self.tick_ns)
