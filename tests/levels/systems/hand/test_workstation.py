"""The workstation of a hand, on a bus of the test: when it plans, and what it sends."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.levels.errors import LevelError
from rack.levels.level import LevelContext
from rack.levels.systems.hand.messages import GraspKind
from rack.levels.systems.hand.workstation import Workstation
from tests.levels.arms import cell, config

HAND = cell("utah_mit")
START = HAND.start()
SIZES = {"joints": 16, "fingers": 4, "bodies": 1, "state": 1}


class Crate:
    """A bus with one board, whose messages the test sets: ports of `Workstation`. A second passes
    between two looks."""

    tasks = ("coordinator",)
    tick = 12

    def __init__(self) -> None:
        self.messages = {
            port: source.message.zeros(SIZES) for port, source in Workstation.inputs.items()
        }
        self.sends: list[dict[str, Any]] = []
        self.looks = 20
        world = self.messages["world"]
        world.position, world.quaternion = START.xpos[HAND.bodies], START.xquat[HAND.bodies]
        world.sensed = 7

    @property
    def is_over(self) -> bool:
        self.looks -= 1
        return self.looks < 0

    @property
    def time_s(self) -> float:
        return 20.0 - self.looks

    def wait(self, timeout_s: float) -> bool:
        return True

    def read(self, port: str) -> Reading:
        return Reading(self.messages[port], Verdict.OLD)

    def send(self, port: str, **fields: Any) -> bool:
        assert port == "plan"
        self.sends.append(fields)
        return True


def workstation(**params: Any) -> Workstation:
    robot, scene = config("utah_mit")
    table = {
        "object": "can",
        "opposing": "thumb",
        "every_s": 1e-6,
    }
    context = LevelContext(
        board="workstation",
        every=1,
        within_cycles=1,
        clock_ns=500_000,
        seed=1,
        robot=robot,
        scene=scene,
        task={},
        sizes=SIZES,
        params={**table, **params},
        rack="lab",
    )
    return Workstation(context)


@pytest.mark.slow
def test_it_plans_once_and_anew_when_the_object_moves_before_it_is_held() -> None:
    crate, host = Crate(), workstation()
    host.run(crate)  # type: ignore[arg-type]
    (plan,) = crate.sends
    assert (plan["object"], plan["sensed"]) == (0, 7)
    assert {key: np.shape(plan[key]) for key in ("contact", "normal", "posture")} == {
        "contact": (4, 3),
        "normal": (4, 3),
        "posture": (16,),
    }
    crate.messages["world"].position[0, 2] += 0.002
    host.plan_grasp(crate)  # type: ignore[arg-type]
    assert len(crate.sends) == 1
    crate.messages["world"].position[0, 0] += 0.004
    host.plan_grasp(crate)  # type: ignore[arg-type]
    assert len(crate.sends) == 2
    crate.messages["grasp"].kind = GraspKind.HOLD
    crate.messages["world"].position[0, 0] += 0.01
    host.plan_grasp(crate)  # type: ignore[arg-type]
    assert len(crate.sends) == 2


def test_it_waits_until_it_knows_object_and_coordinator() -> None:
    with pytest.raises(LevelError, match="object = cup: not in the scene; objects: can"):
        workstation(object="cup")
    with pytest.raises(LevelError, match="opposing = little: the hand has no such finger"):
        workstation(opposing="little")
    crate, host = Crate(), workstation()
    crate.read = lambda port: Reading(crate.messages[port], Verdict.NONE)  # type: ignore[method-assign]
    host.run(crate)  # type: ignore[arg-type]
    assert not crate.sends
