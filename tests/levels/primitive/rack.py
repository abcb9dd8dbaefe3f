"""A rack of servo, world model and primitive level in one process, commanded by the test."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rack.levels.messages import MoveCommand, SegmentKind
from rack.levels.primitive import PrimitiveExecutor, PrimitivePlanner
from rack.levels.servo import ServoExecutor, ServoPlanner
from rack.levels.tables import MotionConfig
from rack.levels.world import WorldModel
from tests.levels.arms import config
from tests.levels.lockstep import BoardSpec, Lockstep

Segment = Mapping[str, Any]

TURN = np.array([0.6, -0.1, 0.2, 0.0, 0.1, 0.3])
BEND = np.array([0.3, 0.0, 0.0, 0.4, 0.0, -0.3])
"""Two displacements from home, rad."""


class PrimitiveRack(Lockstep):
    """The primitive level above servo and simulated cell; `seen`, `set_points`: its messages."""

    def __init__(
        self,
        name: str = "puma560",
        motion: Sequence[MotionConfig] = (),
        params: Mapping[str, Any] | None = None,
    ) -> None:
        robot, scene = config(name)
        places: Any = {"above": "em", "below": "servo", "params": params or {}}
        boards = [
            BoardSpec("servo", 1, ServoExecutor, ServoPlanner, 8, above="primitive"),
            BoardSpec("world", 8, WorldModel),
            BoardSpec("primitive", 8, PrimitiveExecutor, PrimitivePlanner, 2, **places),
        ]
        scene = scene.model_copy(update={"motion": tuple(motion)})
        super().__init__(boards, robot, scene, outside={"em.command": MoveCommand})
        self.home, self.fastest = np.array(robot.home), np.array(robot.velocity)
        self.seen: list[dict[str, Any]] = []
        self.set_points: list[dict[str, Any]] = []

    def step(self) -> None:
        super().step()
        if self.tick % 8 == 0:
            self.seen.append(_fields(self.read("primitive.status").record))
            self.set_points.append(_fields(self.read("primitive.command").record))

    def command(self, *segments: Segment, hold: bool = False) -> None:
        message = self.message("em.command")
        message.id = max((segment["id"] for segment in segments), default=0)
        message.hold = hold
        message.count = len(segments)
        for record, segment in zip(message.segments, segments, strict=False):
            for key, value in segment.items():
                if np.ndim(value):
                    record[key][: len(value)] = value
                else:
                    record[key] = value
        self.write("em.command", message)

    @property
    def status(self) -> Any:
        return self.read("primitive.status")

    @property
    def servo(self) -> Any:
        return self.read("servo.status")

    def run_until_done(self, segment: int, seconds: float = 10.0) -> bool:
        """Run until `segment` is done. Return False if that takes more than `seconds`."""
        return self.run(seconds, until=lambda rack: rack.read("primitive.status").done >= segment)

    def run_until_error(self) -> Any:
        """Run until the level reports an error; return its status."""
        self.run(4.0, until=lambda rack: rack.read("primitive.status").error != 0)
        return self.status


def path(serial: int, waypoints: ArrayLike, blend: Any = None, **fields: Any) -> Segment:
    """Return a PATH segment. Without `blend` the arm stops at every corner."""
    points = np.array(waypoints)
    blends = np.zeros(len(points)) if blend is None else blend
    segment = {"id": serial, "kind": SegmentKind.PATH, "object": -1, "count": len(points)}
    return segment | {"waypoints": points, "blend": blends} | fields


def two_paths(rack: PrimitiveRack) -> tuple[Segment, Segment]:
    """Return a straight path and one back home around a corner."""
    a, b = rack.home + TURN, rack.home + BEND
    return path(1, [rack.home, a]), path(2, [a, b, rack.home], [0.0, 0.2, 0.0])


def gripper(serial: int, opening: float, held: int = -1, force: float = 30.0) -> Segment:
    segment = {"id": serial, "kind": SegmentKind.GRIPPER, "object": held}
    return segment | {"opening": opening, "force": force}


def _fields(record: np.ndarray) -> dict[str, Any]:
    return {name: np.array(record[name]) for name in record.dtype.names or ()}
