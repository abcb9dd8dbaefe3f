"""All levels of a rack in one process, which calls `process` and `plan` of each in turn.

Use it to test your own level, or to measure the work of the levels without the rack:

    from rack.boards import OneProcess

    with OneProcess.from_file("metered.toml") as rack:
        rack.run(2.0)
        assert rack.newest("power.status").energy > 0.0

Levels, ports and delays are those of the resolved config. As under protocol time-slice, the tick
alone determines when a message becomes visible. Every level therefore reads the same messages and
acts in the same way as in a rack in lockstep. There is no clock, shared memory, check or trace, and
there are no commands or faults.
"""

from __future__ import annotations

import gc
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

from rack.backplane.layout import Layout, MailboxSpec
from rack.backplane.mailbox.slots import build_message_dtype
from rack.backplane.message import AnyMessage, Message
from rack.boards.config import RackConfig, load, resolve
from rack.boards.errors import LaunchError
from rack.boards.wiring import TaskWiring
from rack.levels.level import Executor, Planner, Reading, Verdict
from rack.levels.references import find_class


class OneProcess:
    """Levels of a rack in one process, as a context manager that closes them.

    Attributes:
        tick: The next tick.

    Raises:
        ConfigError: The config has mistakes. All of them are listed.
        LaunchError: The rack has host boards, queues, exchanges or interrupts, which need
            processes.
    """

    def __init__(self, config: RackConfig) -> None:
        plan = resolve(config)
        if boards := [
            spec.name
            for spec in plan.layout.mailboxes
            if spec.exchanges or spec.capacity or spec.interrupt is not None
        ]:
            raise LaunchError(
                f"{', '.join(boards)}: a queue, an exchange or interrupts, which only a rack with"
                " boards has"
            )
        if plan.hosts:
            names = [host.board for host in plan.hosts]
            raise LaunchError(f"{', '.join(names)}: a host board, which needs a separate process")
        self.tick = 0
        self._clock_ns = plan.layout.clock_ns
        self._mailboxes = {spec.name: PrivateMailbox(spec) for spec in plan.layout.mailboxes}
        self._tasks = [PrivateTask(plan.layout, wiring, self._mailboxes) for wiring in plan.tasks]
        self._cycles = [(*task.spec.grid, task.cycle) for task in self._tasks]

    @classmethod
    def from_file(cls, config: str | Path, overrides: Sequence[str] = ()) -> Self:
        """Create the levels of a config. The arguments are those of `load`."""
        return cls(load(config, overrides))

    def __enter__(self) -> Self:
        try:
            for task in self._tasks:
                task.level.self_test()
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self.close()

    def close(self) -> None:
        """Close all levels."""
        for task in self._tasks:
            task.level.close()

    def run(self, seconds: float) -> None:
        """Run for `seconds` of simulated time. Exceptions raised by levels propagate."""
        self.run_ticks(round(seconds * 1e9 / self._clock_ns))

    def run_ticks(self, ticks: int) -> None:
        """Run for a number of ticks. Exceptions raised by levels propagate."""
        # As in a board, the garbage collector must not run during cycles.
        gc.collect()
        gc.freeze()
        gc.disable()
        try:
            for tick in range(self.tick, self.tick + ticks):
                self.tick = tick + 1
                for every, phase, cycle in self._cycles:
                    if tick % every == phase:
                        cycle(tick)
        finally:
            gc.enable()
            gc.unfreeze()

    def newest(self, mailbox: str) -> AnyMessage:
        """Return a copy of the newest message that was visible in the last tick of the run.

        Raises:
            LookupError: The mailbox does not exist, or no message was visible.
        """
        box = self._mailboxes.get(mailbox)
        if box is None:
            raise LookupError(f"no mailbox '{mailbox}'; mailboxes: {', '.join(self._mailboxes)}")
        newest = box.find_newest(self.tick - 1)
        if newest is None:
            raise LookupError(f"'{mailbox}' is empty at tick {self.tick - 1}")
        message = AnyMessage(box.dtype)
        message.raw[:] = newest[1]
        return message

    @property
    def serials(self) -> Mapping[str, int]:
        """Serial of each mailbox's newest visible message. Mailboxes without one are left out."""
        newest = {name: box.find_newest(self.tick - 1) for name, box in self._mailboxes.items()}
        return {name: entry[0] for name, entry in newest.items() if entry is not None}


class PrivateMailbox:
    """Mailbox in private memory.

    Attributes:
        spec: Its record in the layout.
        dtype: numpy type of its messages.
        message: Message that the writer fills.
        serial: Serial of the last written message.
        stored: The newest visible message and those that are not visible yet, oldest first. Each is
            a tuple of the tick at which it becomes visible, its serial and its bytes.
    """

    def __init__(self, spec: MailboxSpec) -> None:
        self.spec = spec
        self.dtype = build_message_dtype(spec.fields, spec.size)
        self.message = AnyMessage(self.dtype)
        self.serial = 0
        self.stored: deque[tuple[int, int, bytes]] = deque(maxlen=spec.delay // spec.every + 2)

    def write(self, tick: int, cycle: int) -> None:
        """Store the message if the mailbox is to be written at the end of this cycle.

        Args:
            tick: Tick at which the cycle was released.
            cycle: Length of the cycle in ticks.
        """
        if not (tick + cycle - self.spec.phase) % self.spec.every:
            self.serial += 1
            self.stored.append((tick + self.spec.delay, self.serial, bytes(self.message.raw)))

    def find_newest(self, tick: int) -> tuple[int, bytes] | None:
        """Return serial and bytes of the newest message visible at `tick`. None without one."""
        for visible_at, serial, data in reversed(self.stored):
            if visible_at <= tick:
                return serial, data
        return None


class PrivateReader:
    """Reader of a `PrivateMailbox`, with the same verdicts as the readers of a board."""

    def __init__(self, box: PrivateMailbox, kind: type[Message]) -> None:
        self._box = box
        self._serial = 0
        self._message = kind(box.dtype)
        self._readings = {verdict: Reading(self._message, verdict) for verdict in Verdict}

    def read(self, tick: int) -> Reading[Message]:
        """Return the newest message visible at `tick` with its verdict."""
        newest = self._box.find_newest(tick)
        if newest is None:
            return self._readings[Verdict.NONE]
        serial, data = newest
        if serial == self._serial:
            return self._readings[Verdict.OLD]
        self._serial = serial
        self._message.raw[:] = data
        return self._readings[Verdict.NEW]


class PrivateTask:
    """An executor or planner with its ports connected to mailboxes in private memory.

    Args:
        layout: Layout of the rack.
        wiring: Wiring of the task.
        boxes: All mailboxes, keyed by name.
    """

    def __init__(
        self, layout: Layout, wiring: TaskWiring, boxes: Mapping[str, PrivateMailbox]
    ) -> None:
        self.spec = layout.find_task(wiring.task)
        kind: type[Executor] | type[Planner] = find_class(
            wiring.target, Executor if self.spec.role == "executor" else Planner
        )
        kind.preload()
        self.level = level = kind(wiring.context)
        # Table, key and function of each reading. The table belongs to the level's ports, or to one
        # port that reads several mailboxes.
        self._readers: list[tuple[dict[str, Any], str, Callable[[int], Reading[Message]]]] = []
        for port, source in wiring.inputs.items():
            message = level.inputs[port].message if port in level.inputs else AnyMessage
            table = level.find_input_table(port)
            if not isinstance(source, str):
                table[port] = table = {}
            for key, mailbox in ({port: source} if isinstance(source, str) else source).items():
                read = PrivateReader(boxes[mailbox], message).read
                table[key] = read(-1)
                self._readers.append((table, key, read))
        self._boxes = [boxes[name] for name in wiring.outputs.values()]
        for port, name in wiring.outputs.items():
            message = level.outputs[port].message if port in level.outputs else AnyMessage
            level.store_output(port, message(boxes[name].dtype, boxes[name].message.raw))
        self._busy_until = 0

    def cycle(self, tick: int) -> None:
        """Run the cycle released at `tick`: read every input, process, and write what is due.

        A planner makes a plan if the time slice of its last plan is over and it wants one.
        """
        if tick < self._busy_until:
            return
        for values, key, read in self._readers:
            values[key] = read(tick)
        level = self.level
        if isinstance(level, Executor):
            level.process(tick)
            level.findings.clear()
        elif level.wanted(tick):
            self._busy_until = tick + self.spec.slice
            level.plan(tick)
        else:
            return
        for box in self._boxes:
            box.write(tick, self.spec.every)
