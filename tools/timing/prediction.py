"""The timing that follows from a config alone: what the time slices make of eqs 3.2, 3.3 and 3.8."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from math import gcd

from rack.backplane.layout import Layout
from rack.boards.config.schema import RackConfig
from rack.levels.timing.equations import system_response_bound_ns, system_response_ns


@dataclass(frozen=True)
class Prediction:
    """Response of the hierarchy `levels`, highest first, in ms of simulated time; all 0 without one.

    `command_ms` and `status_ms` are the bounds down and up with the waits for the grid; `plan_ms` is, by
    level, the time from a planner's release until its plan can be used.
    """

    levels: tuple[str, ...]
    bound_eq_3_2_ms: float
    sum_eq_3_3_ms: float
    command_ms: float
    status_ms: float
    plan_ms: dict[str, float]

    def lines(self) -> Iterator[str]:
        """Yield the prediction as text."""
        if self.levels:
            yield ""
            yield f"system response, {' > '.join(self.levels)}:"
            yield f"  eq. 3.3 sum of the cycles {self.sum_eq_3_3_ms:g} ms, eq. 3.2 bound {self.bound_eq_3_2_ms:g} ms"
            yield f"  on the clock's grid: a command down {self.command_ms:g} ms, a status up {self.status_ms:g} ms"
        for level, plan_ms in self.plan_ms.items():
            yield f"plan of {level}: used {plan_ms:g} ms after its planner's release"


def chains(config: RackConfig) -> tuple[tuple[str, ...], ...]:
    """Return every way from a highest board to a lowest: with a board a joint there is one for every joint."""
    lowest = [name for name, board in config.board.items() if board.above is not None and board.below is None]
    return tuple(_chain(config, name) for name in lowest)


def _chain(config: RackConfig, lowest: str) -> tuple[str, ...]:
    chain = [lowest]
    while (above := config.board[chain[0]].above) is not None and above not in chain:
        chain.insert(0, above)
    return tuple(chain)


def hierarchy(config: RackConfig) -> tuple[str, ...]:
    """Return the boards of the chain that responds last, from the highest to the lowest; empty when there is none."""
    return max(chains(config), key=lambda chain: response_ticks([config.every(name) for name in chain]), default=())


def longest_cycles(config: RackConfig) -> dict[str, float]:
    """Return R_max by board, in ticks: the longest cycle that a level may have.

    With a goal for the response it is R_s / n (eq. 3.2); without one the longest cycle of all that are in one hierarchy
    with the board. A board outside of all has its own.
    """
    found = {name: float(config.every(name)) for name in config.board}
    ways, goal_ms = sorted(chains(config), key=len), config.timing.response_ms
    for chain in ways:
        if goal_ms is None:
            together = {name for other in ways if other[0] == chain[0] for name in other}
            longest = float(max(config.every(name) for name in together))
        else:
            longest = goal_ms / config.clock.period_ms / len(chain)
        found |= dict.fromkeys(chain, longest)
    return found


def response_ticks(cycles: list[int]) -> int:
    """Return the longest time from the first level's release to the end of the cycle of the last that acts on it.

    `cycles` are in ticks, in the order of the information's way. Each level takes its cycle (eq. 3.3); where one
    cycle does not divide the next, a message also waits for the reader's next release on the common grid (eq. 3.7).
    """
    return sum(cycles) + sum(later - gcd(earlier, later) for earlier, later in pairwise(cycles))


def predict(config: RackConfig, layout: Layout) -> Prediction:
    """Return the timing of a config."""
    levels, tick_ms = hierarchy(config), layout.clock_ns * 1e-6
    cycles = [layout.task(name).every for name in levels]
    planners = [task for task in layout.tasks if task.role == "planner"]
    return Prediction(
        levels=levels,
        bound_eq_3_2_ms=system_response_bound_ns(cycles or [0]) * tick_ms,
        sum_eq_3_3_ms=system_response_ns((), cycles) * tick_ms,
        command_ms=response_ticks(cycles) * tick_ms,
        status_ms=response_ticks(cycles[::-1]) * tick_ms,
        plan_ms={task.board: task.every * task.within_cycles * tick_ms for task in planners},
    )
