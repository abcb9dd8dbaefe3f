"""A grasp by all loops of a hand keeps its object while the object is pulled and boards die."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pytest

from rack.backplane.message import Message, State
from rack.levels.level import Input
from rack.levels.messages import Error, Scene
from rack.levels.systems.hand import (
    FingerExecutor,
    FingertipLoop,
    GraspExecutor,
    HandExecutor,
    JointLoop,
    TendonLoop,
)
from rack.levels.systems.hand.grasp_program import GraspProgram
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
    """Runs a program of a grasp, with a board per loop ("loops") or per finger ("fingers")."""

    def __init__(
        self,
        boards: str,
        steps: Sequence[Mapping[str, Any]],
        pushes: tuple[PushConfig, ...] = (),
        **params: Any,
    ) -> None:
        robot, scene = config("utah_mit")
        at = {"above": "grasp", "below": "hand"}
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
                *(BoardSpec(f, EVERY, FingerExecutor, **at, params={"finger": f}) for f in FINGERS),
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


pytestmark = pytest.mark.thorough

PULL = PushConfig(body="can", at=2.4, seconds=0.5, force=(-4.0, 0.0, 0.0), rise=0.1)
LOWER = {**LIFT, "by": [0.0, 0.0, -0.006]}
HOLD = {"do": "hold", "seconds": 0.8}
RELEASE = {"do": "release", "seconds": 0.4}


@pytest.mark.parametrize("boards", ["loops", "fingers"])
def test_an_object_is_lifted_kept_while_it_is_pulled_and_put_back(boards: str) -> None:
    rig = GraspRig(boards, [PRESHAPE, CLOSE, SQUEEZE, LIFT, HOLD, LOWER, RELEASE], (PULL,))
    assert rig.go(3.0, steps=3)
    squeezed = rig.read("world.model").position[0].copy()
    assert rig.go(3.0, steps=4)
    assert rig.read("world.model").position[0, 2] - squeezed[2] > 0.004
    assert rig.go(6.0)
    status = rig.grasp
    assert (status.state, status.error, status.step) == (State.DONE, Error.NONE, 7)
    assert status.farthest < 0.005
    assert rig.least_tension > 2.0
    assert not rig.read("hand.status").force.any()


@pytest.mark.parametrize("board", ["grasp", "joint", "hand"])
def test_a_board_that_dies_leaves_the_object_in_the_hand(board: str) -> None:
    rig = GraspRig("loops", [PRESHAPE, CLOSE, SQUEEZE, {**HOLD, "seconds": 0.5}])
    assert rig.go(3.0, steps=3)
    rig.lose(board, ticks=200)
    assert rig.go(4.0)
    status = rig.grasp
    assert (status.state, status.error, status.reason) == (State.DONE, Error.NONE, "")
    assert status.touching.all()
    assert status.farthest < 0.003


def test_a_program_that_is_kept_for_too_long_fails() -> None:
    rig = GraspRig("fingers", [PRESHAPE, CLOSE], stalled=0.3)
    rig.run(0.2)
    rig.lose("thumb", ticks=2000)
    assert rig.go(0.9)
    status = rig.grasp
    assert (status.state, status.error) == (State.ERROR, Error.STALLED)
    assert status.reason.startswith("waited for 0.3 s: ")


NAMES = ", ".join(FINGERS)
WRONG: dict[str, tuple[dict[str, Any], str, str]] = {
    "finger": (program() | {"opposing": "little"}, "opposing", f"no such finger; fingers: {NAMES}"),
    "posture": (
        program({**PRESHAPE, "posture": "fist"}),
        "step[0].posture",
        "no such posture; postures: open, around",
    ),
    "object": (
        program({**CLOSE, "object": "cup"}),
        "step[0].object",
        "not in the scene; objects: can",
    ),
    "order": (program(SQUEEZE), "step[0].do", "a 'close' must come before it"),
    "held": (program(CLOSE, PRESHAPE), "step[1].do", "a 'release' must come before it"),
    "lone": (
        program({**CLOSE, "points": {"thumb": [0.0, 0.0, 0.0]}}),
        "step[0].points",
        "the opposing finger, 'thumb'",
    ),
    "short": (
        {"posture": {"fist": {"thumb": [1.0]}}},
        "posture.fist.thumb",
        "1 values; it needs 4, one per joint",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_mistakes_of_a_program_name_key_and_what_is_permitted(case: str) -> None:
    task, key, reason = WRONG[case]
    misfits = GraspProgram.model_validate(task).find_mismatches(*config("utah_mit"))
    assert reason in {key: why for key, _, why in misfits}[key]
