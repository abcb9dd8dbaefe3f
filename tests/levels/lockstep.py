"""Runs levels in one process, tick by tick, with the visibility of the time-slice protocol.

What a task released at tick T writes is visible from T + n, a plan from T + within_cycles * n, and all that a task
reads is what was visible at its release. So a test sees what boards see, without processes and without waiting.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from backplane.mailbox import Reading, Verdict
from backplane.message import Message, MessageType
from levels.cell import build_cell, sizes
from levels.level import Executor, Input, LevelContext, Pace, Planner, Ports
from levels.robot import RobotConfig
from levels.scene import SceneConfig

CLOCK_NS = 2_500_000


@dataclass(frozen=True)
class BoardSpec:
    """One board of a test's rack: a level and its place in the hierarchy. Every `every` ticks."""

    name: str
    every: int
    executor: type[Executor]
    planner: type[Planner] | None = None
    within_cycles: int = 1
    above: str = ""
    below: str = ""
    params: Mapping[str, Any] = field(default_factory=dict)


class Box:
    """A mailbox under time-slice: messages wait until they are visible."""

    def __init__(self, kind: MessageType, sizes_: Mapping[str, int]) -> None:
        self.kind, self.dtype = kind, kind.dtype(sizes_)
        self._waiting: deque[tuple[int, bytes]] = deque()
        self._now = bytes(self.dtype.itemsize)
        self._serial = 0

    def publish(self, message: Message, visible_at: int) -> None:
        """Let `message` be seen from tick `visible_at` on."""
        self._waiting.append((visible_at, bytes(message.raw)))

    def at(self, tick: int) -> tuple[int, bytes]:
        """Return serial and bytes of the newest message visible at `tick`; serial 0: none yet."""
        while self._waiting and self._waiting[0][0] <= tick:
            self._now = self._waiting.popleft()[1]
            self._serial += 1
        return self._serial, self._now


class Task:
    """An executor or a planner with its ports."""

    def __init__(
        self, level: Executor | Planner, spec: BoardSpec, boxes: Mapping[str, Box], outputs: Mapping[str, Box]
    ) -> None:
        self.level, self.spec, self.due = level, spec, 0
        self._inputs = {port: boxes[source(port_, spec)] for port, port_ in level.inputs.items()}
        self._values = {port: Message(box.dtype) for port, box in self._inputs.items()}
        self._seen = dict.fromkeys(self._inputs, 0)
        self._outputs = outputs
        self.write = Ports(**{port: Message(box.dtype) for port, box in outputs.items()})

    def release(self, tick: int) -> None:
        """Run one cycle."""
        read, span = Ports(**{port: self._read(port, tick) for port in self._inputs}), self.spec.every
        if isinstance(self.level, Executor):
            self.level.process(read, self.write, tick)
            self._publish(tick + span)
        elif self.level.wanted(read, tick):
            span *= self.spec.within_cycles
            self.level.plan(read, self.write.plan, tick)
            self._publish(tick + span)
        self.due = tick + span

    def _read(self, port: str, tick: int) -> Reading:
        serial, data = self._inputs[port].at(tick)
        value, seen = self._values[port], self._seen[port]
        self._seen[port] = serial
        if serial == seen:
            return Reading(value, Verdict.OLD if serial else Verdict.NONE)
        value.raw[:] = data
        return Reading(value, Verdict.NEW)

    def _publish(self, visible_at: int) -> None:
        for port, box in self._outputs.items():
            box.publish(getattr(self.write, port), visible_at)


class Lockstep:
    """A rack in one process. `boxes` are its mailboxes by name, `tick` the tick that is due next."""

    def __init__(
        self,
        boards: Sequence[BoardSpec],
        robot: RobotConfig,
        scene: SceneConfig,
        task: Mapping[str, Any] | None = None,
        seed: int = 1990,
        outside: Mapping[str, MessageType] | None = None,
    ) -> None:
        """Start `boards`. `outside` are mailboxes that the test itself writes, with `write`."""
        self.tick = 0
        self.sizes = sizes(build_cell(robot, scene, CLOCK_NS))
        self.boxes = {name: Box(kind, self.sizes) for name, kind in (outside or {}).items()}
        paces = {board.name: Pace(board.every, board.within_cycles) for board in boards}
        for board in boards:
            kinds = dict(board.executor.outputs) | ({"plan": board.planner.output} if board.planner else {})
            self.boxes |= {f"{board.name}.{port}": Box(kind, self.sizes) for port, kind in kinds.items()}
        self._contexts = {
            b.name: LevelContext(
                board=b.name,
                every=b.every,
                within_cycles=b.within_cycles,
                clock_ns=CLOCK_NS,
                seed=seed,
                robot=robot,
                scene=scene,
                task=task or {},
                sizes=self.sizes,
                below=paces.get(b.below),
                params=b.params,
            )
            for b in boards
        }
        self.tasks = {name: made for b in boards for name, made in self._start(b).items()}

    def _start(self, board: BoardSpec) -> dict[str, Task]:
        context = self._contexts[board.name]
        outputs = {port: self.boxes[f"{board.name}.{port}"] for port in board.executor.outputs}
        started = {board.name: Task(board.executor(context), board, self.boxes, outputs)}
        if board.planner is not None:
            plan = {"plan": self.boxes[f"{board.name}.plan"]}
            started[f"{board.name}.planner"] = Task(board.planner(context), board, self.boxes, plan)
        return started

    def restart(self, name: str) -> None:
        """Replace a task ("primitive", "primitive.planner") by a fresh one, as after the death of its board."""
        spec = self.tasks[name].spec
        fresh = self._start(spec)[name]
        fresh.due = -(-self.tick // spec.every) * spec.every
        self.tasks[name] = fresh

    def message(self, mailbox: str) -> Message:
        """Return an empty message for `mailbox`."""
        return Message(self.boxes[mailbox].dtype)

    def write(self, mailbox: str, message: Message) -> None:
        """Let `message` be seen in `mailbox` from now on."""
        self.boxes[mailbox].publish(message, self.tick)

    def read(self, mailbox: str) -> Message:
        """Return a copy of the newest message that is visible now."""
        message = self.message(mailbox)
        message.raw[:] = self.boxes[mailbox].at(self.tick)[1]
        return message

    def step(self) -> None:
        """Run every task that is released in the present tick."""
        for task in self.tasks.values():
            if task.due == self.tick:
                task.release(self.tick)
        self.tick += 1

    def run(self, seconds: float, until: Callable[[Lockstep], bool] = lambda rack: False) -> bool:
        """Run for simulated `seconds`, or until `until`, asked every 10 ticks, says so; return what it said last."""
        end = self.tick + round(seconds * 1e9 / CLOCK_NS)
        while self.tick < end:
            self.step()
            if self.tick % 10 == 0 and until(self):
                return True
        return False

    @property
    def seconds(self) -> float:
        """Simulated time."""
        return self.tick * CLOCK_NS * 1e-9


def source(port: Input, board: BoardSpec) -> str:
    """Return the mailbox that a port reads."""
    place, _, rest = port.source.partition(".")
    return {"own": board.name, "above": board.above, "below": board.below}.get(place, place) + "." + rest
