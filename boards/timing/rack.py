"""The data of a rack for the timing model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from math import gcd, prod
from typing import Any, NamedTuple

from rack.backplane.layout import TickGrid
from rack.boards.timing.chains import ParallelChains
from rack.boards.timing.interrupts import InboxTiming
from rack.boards.timing.level import BoardTiming, LevelTiming
from rack.boards.timing.response_time import TaskResponse, load_of, task_responses
from rack.boards.timing.tasks import Part, TimedTask, Unit


class CyclicSchedule(NamedTuple):
    """A static cyclic schedule: the minor frame and the major one, a multiple of it, in ticks."""

    minor: int
    major: int


@dataclass(frozen=True)
class RackTiming:
    """The data of a rack for the timing model.

    `clock_ns` is one tick of simulated time. `clock` is the task of the system clock, released
    every tick of the wall clock; its cost is 0 if unknown. `context_switch_ns` is t_cs,
    `small_share` the limit of eq. 3.10. `response_goal_ns` is the goal for the system's response,
    simulated time. Budgets are processor times: a `speed` factor shortens the cycles, not the
    budgets. `inboxes`, by task, are those of boards that messages interrupt; budgets do not include
    what that costs.
    """

    is_lockstep: bool
    speed: float
    clock_ns: int
    clock: TimedTask
    boards: Mapping[str, BoardTiming]
    context_switch_ns: int
    small_share: float
    response_goal_ns: float | None
    inboxes: Mapping[str, InboxTiming]
    schedule: CyclicSchedule | None  # a static one, if the rack has it

    @property
    def tick_ns(self) -> int:
        """One tick of the wall clock."""
        return self.clock.every_ns

    def changed(self, board: str, **changes: Any) -> RackTiming:
        """Return the rack with other values of a board."""
        return replace(self, boards={**self.boards, board: replace(self.boards[board], **changes)})

    @cached_property
    def chains(self) -> tuple[tuple[str, ...], ...]:
        """Every chain of boards from a highest to a lowest; a rack with a board per joint has one
        for every joint.
        """
        lowest = [board.name for board in self.boards.values() if board.above and not board.below]
        return tuple(chain for name in lowest for chain in self._chains((name,)))

    def _chains(self, part: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        """Yield every chain that ends with `part`."""
        above = self.boards[part[0]].above
        if not above:
            yield part
        for name in above:
            yield from self._chains((name, *part))

    @cached_property
    def parallel(self) -> tuple[ParallelChains, ...]:
        """All chains: those of equal cycles together where they are every combination of their
        boards.
        """
        by_cycles: dict[tuple[int, ...], list[tuple[str, ...]]] = {}
        for chain in self.chains:
            by_cycles.setdefault(tuple(self.boards[name].every for name in chain), []).append(chain)
        found = []
        for cycles, chains in by_cycles.items():
            is_every = len(chains) == prod(len(set(boards)) for boards in zip(*chains, strict=True))
            together = [chains] if is_every else [[chain] for chain in chains]
            found += [ParallelChains(tuple(part), cycles) for part in together]
        return tuple(found)

    @property
    def hierarchy(self) -> ParallelChains:
        """The chains with the longest response; without levels above each other, none."""
        return max(self.parallel, key=self.command_ticks, default=ParallelChains((), ()))

    def command_ticks(self, chains: ParallelChains) -> int:
        """Return the longest response of a command along any of these chains, ticks."""
        return max((self.response_ticks(chain) for chain in chains.chains), default=0)

    def status_ticks(self, chains: ParallelChains) -> int:
        """Return the longest response of a status along any of these chains, ticks."""
        return max((self.response_ticks(chain[::-1]) for chain in chains.chains), default=0)

    def response_ticks(self, boards: Sequence[str]) -> int:
        """Return the longest response along boards, in the order in which the information passes,
        ticks: from the release of the first to the end of the cycle of the last that acts on it.

        Each level takes its cycle (eq. 3.3); a message also waits for its next read on the grid.
        """
        passed = [self.boards[name] for name in boards]
        waits = [
            grid_wait(one.releases, other.reads.get(one.name, other.releases))
            for one, other in pairwise(passed)
        ]
        return sum(waits) + sum(board.every for board in passed)

    @cached_property
    def ranks(self) -> tuple[tuple[str, ...], ...]:
        """The boards of all chains by level, the highest first: each as far down as its longest
        chain from above.
        """
        depth: dict[str, int] = {}
        for chain in self.chains:
            for at, name in enumerate(chain):
                depth[name] = max(at, depth.get(name, 0))
        return tuple(
            tuple(name for name in depth if depth[name] == at) for at in sorted(set(depth.values()))
        )

    @cached_property
    def longest_cycles(self) -> dict[str, float]:
        """R_max by board, in ticks: the longest cycle that a level may have.

        With a goal for the response it is R_s / n (eq. 3.2), n being the levels of the longest
        chain through the board; otherwise the longest cycle in its hierarchy. A board outside of
        all hierarchies has its own cycle.
        """
        found = {name: float(board.every) for name, board in self.boards.items()}
        if self.response_goal_ns is None:
            # Chains that share a board are of one hierarchy: the longest passes from one to the
            # next, at least one chain farther in each round.
            for chain in self.chains * len(self.chains):
                found |= dict.fromkeys(chain, max(found[name] for name in chain))
        else:
            for chain in sorted(self.chains, key=len):
                found |= dict.fromkeys(chain, self.response_goal_ns / self.clock_ns / len(chain))
        return found

    def level(self, board: str) -> LevelTiming:
        """Return the timing of a level that has a budget. Raises `KeyError`."""
        table = self.boards[board]
        budget = table.budget
        if budget is None:
            raise KeyError(board)
        planned = table.is_plan_budgeted
        plan_ns = budget.plan_ns + self.interrupted_ns(f"{board}.planner")
        return LevelTiming(
            board=board,
            coupling=table.coupling,
            cycle_ns=table.every * self.tick_ns,
            longest_cycle_ns=round(self.longest_cycles[board] * self.tick_ns),
            read_ns=budget.read_ns + self.interrupted_ns(board),
            execution_ns=budget.process_ns,
            write_ns=budget.write_ns,
            exchange_ns=table.exchange_ns,
            plan_ns=plan_ns if planned else None,
            update_ns=budget.update_ns if planned else 0,
            within_cycles=table.within_cycles if planned else None,
            plan_within_ns=table.plan_within_ns if planned else None,
        )

    def interrupted_ns(self, task: str) -> int:
        """Return the processor time that interrupts take from a task in a cycle, or in a plan; 0 if
        it serves none.
        """
        inbox = self.inboxes.get(task)
        return 0 if inbox is None else inbox.cost_ns(self.slice_ticks(task) * self.clock_ns)

    def slice_ticks(self, task: str) -> int:
        """Return the cycle of an executor, or the time slice of a planner's plan, ticks."""
        board = self.boards[task.removesuffix(".planner")]
        if task == board.name:
            return board.every
        return board.every * board.within_cycles

    @cached_property
    def levels(self) -> dict[str, LevelTiming]:
        """The timing of every level that has a budget, by board."""
        return {
            name: self.level(name)
            for name, board in self.boards.items()
            if board.budget is not None
        }

    @cached_property
    def tasks(self) -> tuple[TimedTask, ...]:
        """The clock's task if its cost is known, and those of every board that has a budget."""
        clock = (self.clock,) if self.clock.cost_ns else ()
        return (*clock, *(task for board in self.boards.values() for task in self._tasks(board)))

    def _tasks(self, board: BoardTiming) -> list[TimedTask]:
        budget = board.budget
        if budget is None:
            return []
        executor = TimedTask(
            name=board.name,
            board=board.name,
            role="executor",
            core=board.core,
            priority=board.priority,
            every_ns=board.every * self.tick_ns,
            phase_ns=board.phase * self.tick_ns,
            parts=_nonzero(
                Part(Unit.EXCHANGE, board.exchange_ns),
                Part(Unit.READ, budget.read_ns + self.interrupted_ns(board.name)),
                Part(Unit.PROCESS, budget.process_ns),
                Part(Unit.WRITE, budget.write_ns),
            ),
        )
        if not board.has_planner:
            return [executor]
        ceiling = board.priority if board.is_critical else 0
        planner = replace(
            executor,
            name=f"{board.name}.planner",
            role="planner",
            core=board.planner_core,
            priority=board.planner_priority,
            parts=_nonzero(
                Part(Unit.PLAN, budget.plan_ns + self.interrupted_ns(f"{board.name}.planner")),
                Part(Unit.UPDATE, budget.update_ns, preemptible=not board.is_critical),
            ),
            within_cycles=board.within_cycles,
            ceiling=ceiling,
        )
        return [executor, planner]

    @cached_property
    def cores(self) -> dict[str, int]:
        """The cores that the config asks for, by task, the clock's first; this machine may lack
        some.
        """
        found = {self.clock.name: self.clock.core}
        for board in self.boards.values():
            found[board.name] = board.core
            if board.has_planner:
                found[f"{board.name}.planner"] = board.planner_core
        return found

    def cores_of(self, board: str) -> set[int]:
        """Return the cores of a board's tasks."""
        return {core for name, core in self.cores.items() if name.partition(".")[0] == board}

    @cached_property
    def responses(self) -> tuple[TaskResponse, ...]:
        """The worst case of every task that has a cost."""
        return task_responses(self.tasks, self.context_switch_ns)

    @cached_property
    def loads(self) -> dict[int, float]:
        """The load of every core, by core; above 1 the core is overloaded."""
        return load_of(self.tasks, self.context_switch_ns)


def _nonzero(*parts: Part) -> tuple[Part, ...]:
    return tuple(part for part in parts if part.time_ns)


def grid_wait(written: TickGrid, read: TickGrid) -> int:
    """Return the longest time, ticks, from a message on the grid of its writer to the next read
    (eq. 3.7).
    """
    common = gcd(written.every, read.every)
    return read.every - common + (read.phase - written.phase) % common
