"""A hand with all of its loops, on a board per loop or per finger, and a grasp loop above."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rack.backplane.message import Message, State
from rack.levels.level import Input
from rack.levels.messages import Scene
from rack.levels.systems.hand import (
    FingerExecutor,
    FingertipLoop,
    GraspExecutor,
    HandExecutor,
    JointLoop,
    TendonLoop,
)
from rack.levels.tables import PushConfig
from rack.levels.world import WorldModel
from tests.levels.arms import config
from tests.levels.lockstep import BoardSpec, Lockstep

CLOCK_NS, EVERY = 500_000, 4
FINGERS = ("index", "middle", "ring", "thumb")
OPEN = {**dict.fromkeys(FINGERS, (0.0, 0.17, 0.26, 0.17)), "thumb": (0.0, 0.05, 0.17, 0.17)}
AROUND = {**dict.fromkeys(FINGERS, (0.0, 0.60, 0.70, 0.64)), "thumb": (0.0, 0.08, 0.90, 0.96)}
POINTS = {"index": [0.014, 0.0, 0.03], "middle": [0.014, 0.0, 0.0], "ring": [0.014, 0.0, -0.03]}
POINTS["thumb"] = [-0.014, 0.0, 0.0]
CLOSE: dict[str, Any] = {"do": "close", "object": "can", "points": POINTS, "speed": 0.06}
PRESHAPE: dict[str, Any] = {"do": "preshape", "posture": "around", "seconds": 0.5}
SQUEEZE = {"do": "squeeze", "grip": 5.0, "seconds": 0.3}
LIFT = {"do": "shift", "by": [0.0, 0.0, 0.006], "seconds": 0.5}


class SceneWorld(WorldModel):
    """A world model that reads the scene of the board of the hand."""

    scene = Input(Scene, "hand.scene")


def program(*steps: Mapping[str, Any]) -> dict[str, Any]:
    return {"posture": {"open": OPEN, "around": AROUND}, "step": list(steps)}


class GraspRig(Lockstep):
    """Runs a program of a grasp.

    `boards` is "loops" for a board per loop, or "fingers" for a board per finger.
    """

    def __init__(
        self,
        boards: str,
        steps: Sequence[Mapping[str, Any]],
        pushes: tuple[PushConfig, ...] = (),
        **params: Any,
    ) -> None:
        robot, scene = config("utah_mit")
        if boards == "loops":
            specs = [
                BoardSpec("hand", EVERY, HandExecutor, above="tendon"),
                BoardSpec("tendon", EVERY, TendonLoop, above="joint", below="hand"),
                BoardSpec("joint", EVERY, JointLoop, above="fingertip", below="tendon"),
                BoardSpec("fingertip", 4 * EVERY, FingertipLoop, above="grasp", below="joint"),
                BoardSpec("grasp", 20 * EVERY, GraspExecutor, below="fingertip", params=params),
            ]
        else:
            specs = [
                BoardSpec("hand", EVERY, HandExecutor, above=FINGERS),
                *(
                    BoardSpec(
                        f, EVERY, FingerExecutor, above="grasp", below="hand", params={"finger": f}
                    )
                    for f in FINGERS
                ),
                BoardSpec("grasp", 5 * EVERY, GraspExecutor, below=FINGERS, params=params),
            ]
        specs.append(BoardSpec("world", 5 * EVERY, SceneWorld))
        pushed = scene.model_copy(update={"push": pushes})
        super().__init__(specs, robot, pushed, task=program(*steps), clock_ns=CLOCK_NS)
        self.least_tension = np.inf  # N, sensed while the valves were open

    @property
    def grasp(self) -> Message:
        return self.read("grasp.status")

    def go(self, seconds: float, steps: int | None = None) -> bool:
        """Run until the program has ended, or `steps` of it are done. Returns False on time-out."""

        def ended(rack: Lockstep) -> bool:
            hand = rack.read("hand.status")
            if hand.state == State.EXECUTING:
                self.least_tension = min(self.least_tension, float(hand.tension.min()))
            status = self.grasp
            return status.state in (State.DONE, State.ERROR) or (
                steps is not None and status.step >= steps
            )

        return self.run(seconds, ended)
