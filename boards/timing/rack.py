"""Data of a rack for the timing model, and the results for its boards, tasks and chains."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from math import gcd, prod
from typing import Any, NamedTuple

from rack.backplane.layout import TickGrid
from rack.backplane.words import Scheduler
from rack.boards.timing.chains import ParallelChains, list_chains
from rack.boards.timing.interrupts import InboxTiming
from rack.boards.timing.level import BoardTiming, LevelTiming
from rack.boards.timing.response_time import TaskResponse, compute_loads, compute_task_responses
from rack.boards.timing.tasks import Budget, Part, TimedTask, Unit


class CyclicSchedule(NamedTuple):
    """Static cyclic schedule: lengths of the minor frame and of the major frame in ticks."""

    minor: int
    major: int


@dataclass(frozen=True)
class RackTiming:
    """Data of a rack for the timing model.

    Attributes:
        is_lockstep: Whether the clock runs in lockstep.
        speed: Simulated time divided by real time. It changes cycles, but not budgets, which are
            processor times.
        clock_ns: Length of a tick in ns of simulated time.
        clock: Task of the system clock, released every tick. Its cost is 0 if it is not known.
        boards: Boards, keyed by name.
        context_switch_ns: t_cs, the time of one context switch.
        small_share: Largest fraction of a cycle that eq. 3.10 accepts as small.
        response_goal_ns: Goal for the system response in ns of simulated time. None without a goal.
        inboxes: Inboxes of boards that messages interrupt, keyed by task. Budgets do not include
            the time of interrupts.
        schedule: Static cyclic schedule. None if the rack has none.
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
    schedule: CyclicSchedule | None

    @property
    def tick_ns(self) -> int:
        """Length of a tick in ns of the wall clock."""
        return self.clock.every_ns

    def replace_board(self, board: str, **changes: Any) -> RackTiming:
        """Return a copy of the rack in which `changes` replace fields of one board."""
        return replace(self, boards={**self.boards, board: replace(self.boards[board], **changes)})

    @cached_property
    def chains(self) -> tuple[tuple[str, ...], ...]:
        """Every chain of boards from a highest to a lowest level.

        A rack with one board per joint has a chain for each joint.
        """
        return list_chains({name: board.above for name, board in self.boards.items()})

    @cached_property
    def chain_groups(self) -> tuple[ParallelChains, ...]:
        """All chains, grouped by timing.

        Chains with equal cycles form one group if they contain every combination of one board per
        level. Otherwise each of them is a group.
        """
        by_cycles: dict[tuple[int, ...], list[tuple[str, ...]]] = {}
        for chain in self.chains:
            by_cycles.setdefault(tuple(self.boards[name].every for name in chain), []).append(chain)
        parallel = []
        for cycles, chains in by_cycles.items():
            combinations = prod(len(set(boards)) for boards in zip(*chains, strict=True))
            groups = [chains] if len(chains) == combinations else [[chain] for chain in chains]
            parallel += [ParallelChains(tuple(group), cycles) for group in groups]
        return tuple(parallel)

    @property
    def hierarchy(self) -> ParallelChains:
        """Group of chains with the longest response to a command. Empty if there are no chains."""
        return max(
            self.chain_groups, key=self.compute_longest_ticks, default=ParallelChains((), ())
        )

    def compute_longest_ticks(self, chains: ParallelChains, step: int = 1) -> int:
        """Return the longest response in ticks along any of these chains.

        Args:
            chains: The chains.
            step: 1 for commands, which pass down, or -1 for statuses, which pass up.
        """
        return max(
            (self.compute_response_ticks(chain[::step]) for chain in chains.chains), default=0
        )

    def compute_response_ticks(self, boards: Sequence[str]) -> int:
        """Return the longest response, in ticks, along a sequence of boards.

        It lasts from the release of the first board to the end of the cycle in which the last board
        acts: one cycle of each level (eq. 3.3), and the time that each message waits to be read.

        Args:
            boards: Names of the boards, in the order in which the information flows.
        """
        row = [self.boards[name] for name in boards]
        waits = [
            compute_grid_wait(sender.releases, receiver.reads.get(sender.name, receiver.releases))
            for sender, receiver in pairwise(row)
        ]
        return sum(waits) + sum(board.every for board in row)

    @cached_property
    def ranks(self) -> tuple[tuple[str, ...], ...]:
        """Boards of all chains, grouped by rank, from the top down.

        The rank of a board is the length of the longest chain of boards above it.
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
        """R_max of each board: the longest cycle, in ticks, that its level may have.

        If there is a goal R_s for the response, R_max is R_s / n (eq. 3.2), where n is the number
        of levels in the longest chain through the board. Otherwise R_max is the longest cycle in
        the board's hierarchy. For a board without neighbours it is the board's own cycle.
        """
        longest = {name: float(board.every) for name, board in self.boards.items()}
        if self.response_goal_ns is None:
            # Chains that share a board belong to one hierarchy. In each round the longest cycle is
            # propagated to at least one more chain.
            for chain in self.chains * len(self.chains):
                longest |= dict.fromkeys(chain, max(longest[name] for name in chain))
        else:
            for chain in sorted(self.chains, key=len):
                longest |= dict.fromkeys(chain, self.response_goal_ns / self.clock_ns / len(chain))
        return longest

    def compute_interrupted_ns(self, task: str) -> int:
        """Return the time in ns that interrupts take from one computation of a task.

        It is 0 if the task does not serve an inbox or has no budget.
        """
        return self._interrupted_ns.get(task, 0)

    @cached_property
    def _interrupted_ns(self) -> dict[str, int]:
        """Time that interrupts take from one computation of each task that serves an inbox.

        They take it from the release to the response, which depends on the handlers of all tasks.
        Both times are raised until they agree. The cost of each inbox is bounded.
        """
        lasting_ns = dict.fromkeys(self.inboxes, 0)
        while True:
            taken_ns = {
                task: inbox.compute_cost_ns(lasting_ns[task])
                for task, inbox in self.inboxes.items()
            }
            before_ns = dict(lasting_ns)
            tasks = self._build_tasks(taken_ns) if taken_ns else ()
            for each in compute_task_responses(tasks, self.context_switch_ns, self.tick_ns):
                if each.response_ns and each.task in taken_ns:
                    computing_ns = each.response_ns - taken_ns[each.task]
                    lasting_ns[each.task] = max(before_ns[each.task], computing_ns)
            if lasting_ns == before_ns:
                return taken_ns

    @cached_property
    def levels(self) -> dict[str, LevelTiming]:
        """Timing of every level that has a budget, keyed by board."""
        return {
            name: self._build_level(board, board.budget)
            for name, board in self.boards.items()
            if board.budget is not None
        }

    def _build_level(self, board: BoardTiming, budget: Budget) -> LevelTiming:
        """Return the timing of the level of a board with this budget."""
        has_plan = board.is_plan_budgeted
        plan_ns = budget.plan_ns + self.compute_interrupted_ns(f"{board.name}.planner")
        return LevelTiming(
            board=board.name,
            coupling=board.coupling,
            cycle_ns=board.every * self.tick_ns,
            longest_cycle_ns=round(self.longest_cycles[board.name] * self.tick_ns),
            read_ns=budget.read_ns,
            execution_ns=budget.process_ns + self.compute_interrupted_ns(board.name),
            write_ns=budget.write_ns,
            exchange_ns=board.exchange_ns,
            plan_ns=plan_ns if has_plan else None,
            update_ns=budget.update_ns if has_plan else 0,
            within_cycles=board.within_cycles if has_plan else None,
            plan_within_ns=board.plan_within_ns if has_plan else None,
        )

    @cached_property
    def tasks(self) -> tuple[TimedTask, ...]:
        """The clock, if its cost is known, and the tasks of every board that has a budget."""
        return self._build_tasks(self._interrupted_ns)

    def _build_tasks(self, taken_ns: Mapping[str, int]) -> tuple[TimedTask, ...]:
        """Return the tasks if interrupts take `taken_ns` from a computation of each task."""
        clock = (self.clock,) if self.clock.cost_ns else ()
        boards = self.boards.values()
        return (*clock, *(t for board in boards for t in self._build_board_tasks(board, taken_ns)))

    def _build_board_tasks(
        self, board: BoardTiming, taken_ns: Mapping[str, int]
    ) -> list[TimedTask]:
        """Return the executor, standbys and planner of a board. Empty without a budget."""
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
            due_ns=board.due * self.tick_ns,
            scheduler=board.scheduler,
            is_critical=board.is_urgent,
            parts=_drop_empty_parts(
                Part(Unit.EXCHANGE, board.exchange_ns),
                Part(Unit.READ, budget.read_ns),
                Part(Unit.PROCESS, budget.process_ns + taken_ns.get(board.name, 0)),
                Part(Unit.WRITE, budget.write_ns),
            ),
        )
        # Whichever copy is active, each one runs the whole cycle.
        executors = [executor, *(replace(executor, **s._asdict()) for s in board.standbys)]
        if not board.has_planner:
            return executors
        planner = replace(
            executor,
            name=f"{board.name}.planner",
            role="planner",
            core=board.planner_core,
            priority=board.planner_priority,
            parts=_drop_empty_parts(
                Part(Unit.PLAN, budget.plan_ns + taken_ns.get(f"{board.name}.planner", 0)),
                Part(Unit.UPDATE, budget.update_ns, preemptible=not board.is_critical),
            ),
            within_cycles=board.within_cycles,
            due_ns=0,
            scheduler=Scheduler.FIXED_PRIORITY,
            ceiling=board.priority if board.is_critical else 0,
        )
        return [*executors, planner]

    @cached_property
    def cores(self) -> dict[str, int]:
        """Core that the config requests for each task. This machine may not have all of them."""
        cores = {self.clock.name: self.clock.core}
        for board in self.boards.values():
            cores[board.name] = board.core
            cores |= {standby.name: standby.core for standby in board.standbys}
            if board.has_planner:
                cores[f"{board.name}.planner"] = board.planner_core
        return cores

    def find_cores(self, board: str) -> set[int]:
        """Return the cores that the tasks of a board use."""
        return {core for name, core in self.cores.items() if name.partition(".")[0] == board}

    @cached_property
    def responses(self) -> tuple[TaskResponse, ...]:
        """Worst-case response of every task that has a cost."""
        return compute_task_responses(self.tasks, self.context_switch_ns, self.tick_ns)

    @cached_property
    def loads(self) -> dict[int, float]:
        """Load of each core. Above 1 a core is overloaded."""
        return compute_loads(self.tasks, self.context_switch_ns)


def _drop_empty_parts(*parts: Part) -> tuple[Part, ...]:
    """Return the parts whose time is not 0."""
    return tuple(part for part in parts if part.time_ns)


def compute_grid_wait(written: TickGrid, read: TickGrid) -> int:
    """Return the longest time in ticks for which a visible message waits to be read.

    Args:
        written: Ticks at which messages become visible.
        read: Ticks at which the reader reads (eq. 3.7).
    """
    common = gcd(written.every, read.every)
    return read.every - common + (read.phase - written.phase) % common
