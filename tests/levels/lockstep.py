"""Runs levels in one process, tick by tick, with the visibility of the time-slice protocol.

Messages that a task released at tick T writes are visible from T + n, a plan from T + within_cycles
* n, and a task reads what was visible at its release. So a test sees what boards see, without
processes and without waiting. Tasks can be lost and come back, mailboxes can be disturbed, as in a
rack whose boards fail; an operator can command.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import AnyMessage, Message
from rack.levels.level import Demand, Executor, LevelContext, Pace, Planner, WrittenPort
from rack.levels.operator import MAX_JOINTS, Goal, Operation, OperatorCommand
from rack.levels.robot.cell import Cell, build_cell, compute_sizes
from rack.levels.tables import RobotConfig, SceneConfig
from tests.levels.box import Box, Disturbance

CLOCK_NS = 2_500_000
Boxes = Mapping[str, Box]


@dataclass(frozen=True)
class BoardSpec:
    """One board of a test's rack: a level and its place in the hierarchy. Every `every` ticks."""

    name: str
    every: int
    executor: type[Executor]
    planner: type[Planner] | None = None
    within_cycles: int = 1
    above: str | tuple[str, ...] = ""
    below: str | tuple[str, ...] = ""
    params: Mapping[str, Any] = field(default_factory=dict)


class Task:
    """An executor or a planner with its ports."""

    def __init__(
        self, level: Executor | Planner, spec: BoardSpec, boxes: Boxes, outputs: Boxes
    ) -> None:
        self.level, self.spec, self.due = level, spec, 0
        # A port that reads many has an input for each board, by (port, board).
        self._inputs: dict[str | tuple[str, str], Box] = {}
        is_executor = isinstance(level, Executor)
        made = spec.executor.build_ports(spec.params, {}).inputs if is_executor else {}
        ports = {**level.inputs, **made}
        self._many = [port for port, input_ in ports.items() if input_.many]
        self._tables = {port: level.find_input_table(port) for port in ports}
        for port, input_ in ports.items():
            place, _, rest = input_.source.partition(".")
            neighbours = {"own": spec.name, "above": spec.above, "below": spec.below}
            for board in listed(neighbours.get(place, place)):
                self._inputs[(port, board) if input_.many else port] = boxes[f"{board}.{rest}"]
        self._values = {
            port: ports[port if isinstance(port, str) else port[0]].message(box.dtype)
            for port, box in self._inputs.items()
        }
        self._seen = dict.fromkeys(self._inputs, 0)
        self._has = dict.fromkeys(self._inputs, False)
        self._outputs = outputs
        kinds = {port: kind.message for port, kind in {**level.outputs, **outputs_of(spec)}.items()}
        self.written: dict[str, Any] = {
            port: kinds[port](box.dtype) for port, box in outputs.items()
        }
        for port, message in self.written.items():
            level.store_output(port, message)

    def release(self, tick: int, demand: Demand = Demand.NONE) -> None:
        """Run one cycle, under a demand on the arm."""
        span = self.spec.every
        for port in self._many:
            self._tables[port][port] = {}
        for port in self._inputs:
            if isinstance(port, str):
                self._tables[port][port] = self._read(port, tick)
            else:
                self._tables[port[0]][port[0]][port[1]] = self._read(port, tick)
        if isinstance(self.level, Executor):
            self.level.demand = demand
            self.level.process(tick)
            self._publish(tick, tick + span)
        elif self.level.wanted(tick):
            span *= self.spec.within_cycles
            self.level.plan(tick)
            self._publish(tick, tick + span)
        self.due = tick + span

    def lose(self, tick: int, finished: bool) -> None:
        """Die; without `finished`, before the plan that it makes is ready."""
        self.due = -1
        for box in self._outputs.values():
            box.lost = True
            if isinstance(self.level, Planner) and not finished:
                box.withdraw(tick)

    def rejoin(self, tick: int) -> None:
        """Be released from the next tick of the grid on."""
        self.due = -(-tick // self.spec.every) * self.spec.every
        for box in self._outputs.values():
            box.lost = False

    def _read(self, port: str | tuple[str, str], tick: int) -> Reading:
        box = self._inputs[port]
        serial, data = box.at(tick)
        value, seen, is_lost = self._values[port], self._seen[port], box.is_lost(tick)
        self._seen[port] = serial
        if serial == seen or data is None:
            return Reading(value, Verdict.OLD if self._has[port] else Verdict.NONE, is_lost)
        value.raw[:] = data
        self._has[port] = True
        return Reading(value, Verdict.NEW, is_lost)

    def _publish(self, tick: int, visible_at: int) -> None:
        kinds = outputs_of(self.spec) if isinstance(self.level, Executor) else {}
        for port, box in self._outputs.items():
            kind = kinds.get(port)
            if kind is None or kind.is_due(tick, self.spec.every, 0):
                box.publish(self.written[port], visible_at)


class Lockstep:
    """A rack in one process. `boxes`: its mailboxes by name; `tick`: the tick that is due next."""

    def __init__(
        self,
        boards: Sequence[BoardSpec],
        robot: RobotConfig,
        scene: SceneConfig,
        task: Mapping[str, Any] | None = None,
        seed: int = 1990,
        outside: Mapping[str, type[Message]] | None = None,
        clock_ns: int = CLOCK_NS,
        name: str = "",
    ) -> None:
        """Start `boards` of rack `name`. The test writes the mailboxes `outside`, with `write`."""
        self.tick, self._clock_ns = 0, clock_ns
        self.demand = Demand.NONE
        self._coming: dict[int, list[Callable[[], None]]] = {}
        self.sizes = compute_sizes(build_cell(robot, scene, clock_ns))
        self.boxes = {name: Box(kind, self.sizes) for name, kind in (outside or {}).items()}
        paces = {board.name: Pace(board.every, board.within_cycles) for board in boards}
        for board in boards:
            for port, output in outputs_of(board).items():
                every = output.cycles * board.every
                self.boxes[f"{board.name}.{port}"] = Box(output.message, self.sizes, every)
            if board.planner is not None:
                plan = board.planner.outputs["plan"].message
                self.boxes[f"{board.name}.plan"] = Box(plan, self.sizes)
            self.boxes[f"{board.name}.operator"] = Box(OperatorCommand, self.sizes)
        self._contexts = {
            b.name: LevelContext(
                board=b.name,
                every=b.every,
                within_cycles=b.within_cycles,
                clock_ns=clock_ns,
                seed=seed,
                robot=robot,
                scene=scene,
                task=task or {},
                sizes=self.sizes,
                above={name: paces[name] for name in listed(b.above) if name in paces},
                below={name: paces[name] for name in listed(b.below) if name in paces},
                params=b.params,
                rack=name,
            )
            for b in boards
        }
        self.tasks = {name: made for b in boards for name, made in self._start(b).items()}

    def _start(self, board: BoardSpec) -> dict[str, Task]:
        context = self._contexts[board.name]
        outputs = {port: self.boxes[f"{board.name}.{port}"] for port in outputs_of(board)}
        started = {board.name: Task(board.executor(context), board, self.boxes, outputs)}
        if board.planner is not None:
            plan = {"plan": self.boxes[f"{board.name}.plan"]}
            started[f"{board.name}.planner"] = Task(board.planner(context), board, self.boxes, plan)
        return started

    def restart(self, name: str) -> None:
        """Replace a task ("primitive", "primitive.planner") as after the death of its board."""
        self.tasks[name].level.close()
        self.tasks[name] = self._start(self.tasks[name].spec)[name]
        self.tasks[name].rejoin(self.tick)

    def lose(self, name: str, ticks: int, finished: bool = True) -> None:
        """Kill a task and restart it `ticks` later; without `finished`, its plan is never made."""
        self.tasks[name].lose(self.tick, finished)
        self.after(ticks, lambda: self.restart(name))

    def disturb(self, mailbox: str, disturbance: Disturbance, ticks: int) -> None:
        """Let a faulty writer write `mailbox` for `ticks`."""
        self.boxes[mailbox].disturbance = disturbance
        self.after(ticks, lambda: setattr(self.boxes[mailbox], "disturbance", None))

    def stop(self, demand: Demand, ticks: int) -> None:
        """Put a demand on the arm for `ticks`."""
        self.demand = demand
        self.after(ticks, lambda: setattr(self, "demand", Demand.NONE))

    def after(self, ticks: int, do: Callable[[], None]) -> None:
        """Do something before the tick that is `ticks` from now."""
        self._coming.setdefault(self.tick + ticks, []).append(do)

    def message(self, mailbox: str) -> AnyMessage:
        return AnyMessage(self.boxes[mailbox].dtype)

    def write(self, mailbox: str, message: Message) -> None:
        """Make `message` visible in `mailbox` from now on."""
        self.boxes[mailbox].publish(message, self.tick)

    def show(self, mailbox: str, **fields: object) -> None:
        """Make a message with these fields visible in `mailbox` from now on."""
        message = self.message(mailbox)
        for name, value in fields.items():
            setattr(message, name, value)
        self.write(mailbox, message)

    def read(self, mailbox: str) -> AnyMessage:
        """Return a copy of the newest whole message that is visible now."""
        message = self.message(mailbox)
        message.raw[:] = self.boxes[mailbox].good_at(self.tick)
        return message

    def show_start(self, cell: Cell, revision: int = 1) -> None:
        """Have the world model show the objects of a cell where they are at the start."""
        start = cell.build_start_data()
        poses = {"position": start.xpos[cell.bodies], "quaternion": start.xquat[cell.bodies]}
        self.show("world.model", revision=revision, **poses)

    def step(self) -> None:
        """Run every task that is released in the present tick."""
        for do in self._coming.pop(self.tick, ()):
            do()
        for task in self.tasks.values():
            if task.due == self.tick:
                task.release(self.tick, self.demand)
        self.tick += 1

    def run(self, seconds: float, until: Callable[[Lockstep], bool] = lambda rack: False) -> bool:
        """Run for `seconds` of simulated time, or until `until`, asked every 10 ticks, is true."""
        end = self.tick + round(seconds * 1e9 / self._clock_ns)
        while self.tick < end:
            self.step()
            if self.tick % 10 == 0 and until(self):
                return True
        return False

    @property
    def seconds(self) -> float:
        return self.tick * self._clock_ns * 1e-9


def listed(boards: str | tuple[str, ...]) -> tuple[str, ...]:
    return boards if isinstance(boards, tuple) else (boards,) if boards else ()


def outputs_of(board: BoardSpec) -> dict[str, WrittenPort[Any, Any]]:
    return {**board.executor.outputs, **board.executor.build_ports(board.params, {}).outputs}


class Operator:
    """Sends commands to levels; every command has the next serial."""

    def __init__(self, rack: Lockstep) -> None:
        self._rack, self.serial = rack, 0

    def say(
        self, level: str, what: Operation, joints: Sequence[float] = (), goal: Goal = Goal.NONE
    ) -> int:
        """Give a command now, with `joints`, rad, as its goal if any; return its serial."""
        padded = np.pad(np.asarray(joints, float), (0, MAX_JOINTS - len(joints)))
        form = Goal.JOINTS if len(joints) else goal
        return self._send(level, what, form, count=len(joints), joints=padded)

    def goto(self, level: str, position: Sequence[float], direction: Sequence[float]) -> int:
        """Send the tool somewhere, m, with its z axis in a direction; return the serial."""
        goal = {"position": position, "direction": direction}
        return self._send(level, Operation.GOTO, Goal.DIRECTION, **goal)

    def modify(self, level: str, name: str, is_on: bool) -> int:
        """Put a control modification in now, or take it out; return the serial."""
        return self._send(level, Operation.MODIFY, Goal.ON if is_on else Goal.OFF, name=name)

    def set(self, level: str, setting: str) -> int:
        """Set a live parameter now; return the serial."""
        return self._send(level, Operation.SET, Goal.NONE, name=setting)

    def _send(self, level: str, what: Operation, goal: Goal, **fields: Any) -> int:
        self.serial += 1
        self._rack.show(f"{level}.operator", id=self.serial, what=what, goal=goal, **fields)
        return self.serial
