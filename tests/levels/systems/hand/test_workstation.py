"""The workstation of a hand on a simulated bus: when it plans, and what it sends."""

from __future__ import annotations

from typing import Any

import pytest

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import Message, copy_message
from rack.levels.errors import LevelError
from rack.levels.level import LevelContext
from rack.levels.messages import WorldState
from rack.levels.systems.hand.messages import GraspKind, GraspPlan, GraspStatus
from rack.levels.systems.hand.workstation import Workstation
from tests.levels.arms import cell, config

HAND = cell("utah_mit")
START = HAND.build_start_data()
SIZES = {"joints": 16, "fingers": 4, "bodies": 1, "state": 1}


class Received:
    """An input of a program, whose message the test sets."""

    def __init__(self, message: Message) -> None:
        self.message: Any = message
        self.verdict = Verdict.OLD

    def read(self) -> Reading[Any]:
        return Reading(self.message, self.verdict)


class Sent:
    """An output of a program, whose messages the test reads."""

    def __init__(self) -> None:
        self.message = GraspPlan.zeros(SIZES)
        self.plans: list[GraspPlan] = []

    def send(self) -> bool:
        self.plans.append(copy_message(self.message))
        return True


class Crate:
    """A bus, and the ports of a `Workstation` on it. Each wait takes a second."""

    tasks = ("coordinator",)
    tick = 12

    def __init__(self) -> None:
        self.world = Received(WorldState.zeros(SIZES))
        self.grasp = Received(GraspStatus.zeros(SIZES))
        self.plan = Sent()
        self.looks = 20
        world = self.world.message
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

    def connect(self, host: Workstation) -> None:
        vars(host).update(world=self.world, grasp=self.grasp, plan=self.plan)


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
def test_it_plans_once_and_again_if_the_object_moves_before_it_is_held() -> None:
    crate, host = Crate(), workstation()
    crate.connect(host)
    host.run(crate)  # type: ignore[arg-type]
    (plan,) = crate.plan.plans
    assert (plan.object, plan.sensed) == (0, 7)
    assert plan.contact.any(axis=1).all()
    assert plan.normal.any(axis=1).all()
    assert plan.posture.any()
    assert plan.grip > 0.0
    crate.world.message.position[0, 2] += 0.002
    host.plan_grasp()
    assert len(crate.plan.plans) == 1
    crate.world.message.position[0, 0] += 0.004
    host.plan_grasp()
    assert len(crate.plan.plans) == 2
    crate.grasp.message.kind = GraspKind.HOLD
    crate.world.message.position[0, 0] += 0.01
    host.plan_grasp()
    assert len(crate.plan.plans) == 2


def test_it_waits_until_it_knows_object_and_coordinator() -> None:
    with pytest.raises(LevelError, match="object = cup: not in the scene; objects: can"):
        workstation(object="cup")
    with pytest.raises(LevelError, match="opposing = little: the hand has no such finger"):
        workstation(opposing="little")
    crate, host = Crate(), workstation()
    crate.connect(host)
    crate.world.verdict = crate.grasp.verdict = Verdict.NONE
    host.run(crate)  # type: ignore[arg-type]
    assert not crate.plan.plans
