"""What the equations need to know of a rack beside its times."""

from __future__ import annotations

from dataclasses import dataclass

from rack.backplane.layout import Layout, TaskSpec
from rack.boards.config.schema import RackConfig
from rack.boards.config.timing import rack_timing


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
        rack = rack_timing(config, layout)
        return cls(
            is_lockstep=rack.is_lockstep,
            tick_ns=rack.tick_ns,
            cycles={name: board.every for name, board in rack.boards.items()},
            longest_cycles=rack.longest_cycles,
            levels=rack.hierarchy,
            tight=frozenset(name for name, board in rack.boards.items() if board.coupling == "tight"),
            critical=frozenset(name for name, board in rack.boards.items() if board.is_critical),
            switch_ns=rack.context_switch_ns,
            small_share=rack.small_share,
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
