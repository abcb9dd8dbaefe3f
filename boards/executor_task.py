"""The executor section of the paper's algorithm: one virtual control loop."""

from __future__ import annotations

from time import monotonic_ns

from rack.backplane.segment import Segment
from rack.backplane.words import Demand, System
from rack.boards.task import Task
from rack.boards.transfer import slowed
from rack.boards.wiring import TaskWiring
from rack.levels.level import Executor

_DEMAND, _DEMANDS = int(System.DEMAND), tuple(Demand)


class ExecutorTask(Task):
    """Runs a level's executor every cycle."""

    def __init__(self, segment: Segment, wiring: TaskWiring, executor: Executor, attention: int | None = None) -> None:
        super().__init__(segment, wiring, executor, attention)
        self.executor = executor
        self._read_plan = slowed(self.inputs.read_plan, wiring.transfer.exchange_ns)
        self._read = slowed(self.inputs.read_rest, wiring.transfer.read_ns)
        self._write = slowed(self.outputs.write, wiring.transfer.write_ns)

    def cycle(self, tick: int) -> None:
        """Read plan, command and status; process; write command and status."""
        start = monotonic_ns()
        self._read_plan(tick)
        plan = monotonic_ns()
        self._read(tick)
        read = monotonic_ns()
        executor = self.executor
        executor.demand = _DEMANDS[self.words[_DEMAND]]
        executor.process(self.inputs.values, self.outputs.messages, tick)
        if executor.findings or executor.acted or self.faults.loads:
            self._tell(tick)
        processed = monotonic_ns()
        in_time = self._write(tick, self.clock.now(), self.inputs)
        self.finish(tick, (start, plan, read, processed, monotonic_ns()), tick + self.spec.every, in_time)

    def _tell(self, tick: int) -> None:
        """Ring what the level has found, count the faults that acted, and compute as long as they say."""
        executor = self.executor
        for alarm, subject, value in executor.findings:
            self.alarms.ring(tick, alarm, subject, value)
        executor.findings.clear()
        self.faults.count(executor.acted, tick)
        executor.acted.clear()
        self.faults.burn(tick)
