"""The executor section of the paper's algorithm: one virtual control loop."""

from __future__ import annotations

from time import monotonic_ns

from backplane.segment import Segment
from boards.task import Task
from boards.wiring import TaskWiring
from levels.level import Executor


class ExecutorTask(Task):
    """Runs a level's executor every cycle."""

    def __init__(self, segment: Segment, wiring: TaskWiring, executor: Executor) -> None:
        super().__init__(segment, wiring)
        self.executor = executor

    def cycle(self, tick: int) -> None:
        """Read command, status and plan; process; write command and status."""
        start = monotonic_ns()
        self.inputs.read(tick)
        read = monotonic_ns()
        self.executor.process(self.inputs.values, self.outputs.messages, tick)
        processed = monotonic_ns()
        in_time = self.outputs.write(tick, self.clock.now(), self.inputs)
        self.finish(tick, start, read, processed, tick + self.spec.every, in_time)
