"""A trajectory level with queued requests and boards that follow its set points."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import Message
from rack.levels.algebra import Array
from rack.levels.level import InputPort, Pace
from rack.levels.messages import WorldState
from rack.levels.operator import Operation, OperatorCommand
from rack.levels.robot.cell import build_cell, compute_sizes
from rack.levels.systems.joint_boards.messages import JointStatus
from rack.levels.systems.trajectory.executor import TrajectoryExecutor
from rack.levels.systems.trajectory.messages import MotionKind, MotionRequest
from tests.levels.arms import config, context

M = TypeVar("M", bound=Message)

CLOCK_NS, EVERY = 1_000_000, 20
PERIOD_S = EVERY * CLOCK_NS * 1e-9
VERDICTS = (Verdict.NEW, Verdict.OLD)


class TrajectoryRig:
    """Runs the level cycle by cycle. Boards follow its set points exactly, or else hold."""

    level_class: type[TrajectoryExecutor] = TrajectoryExecutor
    request_type = MotionRequest

    def __init__(self, arm: str = "puma560_crossing", boards: int = 2, **params: Any) -> None:
        robot, scene = config(arm)
        self.cell = build_cell(robot, scene, CLOCK_NS)
        self.sizes = compute_sizes(self.cell)
        self._kinds: dict[type[Message], np.dtype] = {}
        self.tick = 0
        paces = {f"joints{k}": Pace(1, 1) for k in range(boards)}
        given = {"every": EVERY, "sizes": self.sizes, "below": paces, "params": params}
        self.context = context("trajectory", (robot, scene), **given)
        self.level = self.level_class(self.context)
        self.written: dict[str, Any] = {
            port: self.message(kind.message) for port, kind in self.level.outputs.items()
        }
        self._connect()
        self.statuses = {name: self.message(JointStatus) for name in paces}
        for k, status in enumerate(self.statuses.values()):
            status.driven[k::boards] = 1
            status.target[:] = self.cell.home
            status.holding = 1
        self.world = self.message(WorldState)
        self.world.quaternion[:, 0] = 1.0
        self.world.revision = 1
        self.lost: set[str] = set()
        self.queue: list[Message] = []
        self.ids = 0
        self.order = self.message(OperatorCommand)
        self.ordered = False
        self.positions: list[Array] = []  # of the set points, by cycle
        self.velocities: list[Array] = []

    def _connect(self) -> None:
        for port, message in self.written.items():
            self.level.store_output(port, message)

    def message(self, kind: type[M]) -> M:
        if kind not in self._kinds:
            self._kinds[kind] = kind.message_type.build_dtype(self.sizes)
        return kind(self._kinds[kind])

    def request(self, kind: MotionKind, **fields: Any) -> int:
        """Queue a request and return its id."""
        self.ids += 1
        request = self.message(self.request_type)
        request.id, request.kind, request.body = self.ids, kind, -1
        request.quaternion = (0.0, 0.0, 1.0, 0.0)
        for name, value in fields.items():
            setattr(request, name, value)
        self.queue.append(request)
        return self.ids

    def joints(self, change: Sequence[float] | Array, **fields: Any) -> int:
        """Queue a motion to home plus `change`, rad, and return its id."""
        return self.request(MotionKind.JOINTS, joints=self.cell.home + np.asarray(change), **fields)

    def say(self, what: Operation) -> None:
        self.order.id, self.order.what, self.ordered = self.order.id + 1, what, True

    def restart(self) -> None:
        """Replace the level as after the death of its board: set points end, the boards hold."""

        self.level = self.level_class(self.context)
        self._connect()
        self.brake()

    def brake(self) -> None:
        for status in self.statuses.values():
            status.holding, status.target_velocity = 1, 0.0

    def read(self) -> None:
        most = self.level.max_messages("requests")
        taken, self.queue = self.queue[:most], self.queue[most:]
        requests = Reading(self.message(self.request_type), Verdict.OLD)
        if taken:
            requests = Reading(taken[-1], Verdict.NEW, False, tuple(taken[:-1]))
        boards = {
            name: Reading(status, VERDICTS[name in self.lost], name in self.lost)
            for name, status in self.statuses.items()
        }
        ordered, self.ordered = self.ordered, False
        sources = {p: i for p, i in self.level.inputs.items() if i.source.startswith("own.")}
        own = {port: self._last(source) for port, source in sources.items()}
        own["operator"] = Reading(self.order, VERDICTS[not ordered])
        world = Reading(self.world, Verdict.NEW)
        given = {"requests": requests, "boards": boards, "world": world, **own, **self.others()}
        vars(self.level).update(given)

    def others(self) -> dict[str, Reading]:
        return {}

    def _last(self, source: InputPort[Any, Any]) -> Reading[Any]:
        name = source.source.partition(".")[2]
        there = self.tick > 0 and name in self.level.outputs
        message = self.message(source.message)
        if there:
            message.copy_from(self.written[name])
        return Reading(message, Verdict.OLD if there else Verdict.NONE)

    def obey(self) -> None:
        before = self.written["command"]
        for status in self.statuses.values():
            if before.due and not status.stopped:
                status.holding, status.target = 0, before.position
                status.target_velocity = before.velocity
            else:
                status.holding, status.target_velocity = 1, 0.0

    def cycle(self) -> Message:
        """Run one cycle and return the status."""
        self.obey()
        self.read()
        self.level.process(self.tick)
        self.tick += EVERY
        if self.written["command"].due:
            self.positions.append(self.written["command"].position.copy())
            self.velocities.append(self.written["command"].velocity.copy())
        return self.written["status"]

    def run(self, seconds: float) -> Message:
        """Run for simulated `seconds` and return the status."""
        for _ in range(round(seconds / PERIOD_S)):
            self.cycle()
        return self.written["status"]

    def ends(self) -> dict[int, int]:
        """Return how the last requests ended, by id."""
        status = self.written["status"]
        ended = zip(status.ended, status.ends, strict=True)
        return {int(request): int(how) for request, how in ended if request}

    def excess(self) -> tuple[float, float]:
        """Return the largest velocity and acceleration so far as fractions of the limits."""
        speeds = np.diff(self.positions, axis=0) / PERIOD_S
        bends = np.diff(speeds, axis=0) / PERIOD_S
        limits = self.cell.limits
        fastest, hardest = np.abs(speeds / limits.velocity), np.abs(bends / limits.acceleration)
        return float(fastest.max()), float(hardest.max())
