"""A grasp by all loops of a hand: it takes an object, keeps it and releases it.

It keeps the object while the object is pulled and boards die.
"""

from __future__ import annotations

from typing import Any

import pytest

from rack.backplane.message import State
from rack.levels.messages import Error
from rack.levels.systems.hand.grasp_program import GraspProgram
from rack.levels.tables import PushConfig
from tests.levels.arms import config
from tests.levels.systems.hand.grasp_rig import CLOSE, LIFT, PRESHAPE, SQUEEZE, GraspRig, program

pytestmark = pytest.mark.thorough

PULL = PushConfig(body="can", at=2.4, seconds=0.5, force=(-4.0, 0.0, 0.0), rise=0.1)
LOWER = {**LIFT, "by": [0.0, 0.0, -0.006]}
HOLD = {"do": "hold", "seconds": 0.8}
RELEASE = {"do": "release", "seconds": 0.4}


@pytest.mark.slow
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


@pytest.mark.slow
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


WRONG: dict[str, tuple[dict[str, Any], str, str]] = {
    "finger": (
        program() | {"opposing": "little"},
        "opposing",
        "no such finger; fingers: index, middle, ring, thumb",
    ),
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
    found = {
        key: why
        for key, _, why in GraspProgram.model_validate(task).find_mismatches(*config("utah_mit"))
    }
    assert reason in found[key]
