"""The workstation of a hand on a simulated bus: when it plans, and what it sends."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import Message, copy_message
from rack.levels.algebra import mat_vec
from rack.levels.errors import LevelError
from rack.levels.messages import WorldState
from rack.levels.systems.hand.kinematics import FingerKinematics
from rack.levels.systems.hand.messages import GraspKind, GraspPlan, GraspStatus
from rack.levels.systems.hand.workstation import GraspPlanner, GraspRules, Workstation
from tests.levels.arms import cell, config, context

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
    table = {"object": "can", "opposing": "thumb", "every_s": 1e-6, **params}
    arm, more = config("utah_mit"), {"params": table, "rack": "lab"}
    return Workstation(context("workstation", arm, clock_ns=500_000, sizes=SIZES, **more))


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


CAN_RADIUS_M = 0.024
RULES = GraspRules()
AT, UPRIGHT = START.xpos[HAND.bodies[0]].copy(), np.array([1.0, 0.0, 0.0, 0.0])


@pytest.mark.slow
def test_fingers_and_thumb_press_on_opposite_sides_of_the_surface() -> None:
    found = GraspPlanner(HAND, "thumb", RULES).plan(0, AT, UPRIGHT)
    assert found is not None
    radii = np.sqrt((found.contact[:, :2] ** 2).sum(axis=1))
    assert radii == pytest.approx(np.full(4, CAN_RADIUS_M))
    assert found.normal[:3] == pytest.approx(-found.normal[[3, 3, 3]])
    # Each pushes into the object, through its axis.
    assert found.normal[:, :2] == pytest.approx(-found.contact[:, :2] / CAN_RADIUS_M)
    assert 0.1 < found.margin < 0.5
    # They close from tips that are clear of the object by as much as asked.
    outside = AT + found.contact - RULES.clear * found.normal
    palm = START.site_xmat[HAND.tool].reshape(3, 3).T
    wanted = np.array([mat_vec(palm, point - START.site_xpos[HAND.tool]) for point in outside])
    assert HAND.hand is not None
    kinematics = FingerKinematics(HAND, HAND.hand)
    kinematics.set_position(found.posture)
    tips = np.array([kinematics.find_tip(finger) for finger in range(4)])
    assert np.abs(tips - wanted).max() < 2e-3


@pytest.mark.slow
def test_the_grip_bears_weight_and_pull_by_friction_with_a_reserve() -> None:
    found = GraspPlanner(HAND, "thumb", GraspRules(pull=4.0, reserve=2.0)).plan(0, AT, UPRIGHT)
    assert found is not None
    # 0.15 kg, friction 1, three fingers that press and a thumb that bears their sum.
    assert 2.0 * 3.0 * found.grip == pytest.approx(2.0 * (0.15 * 9.81 + 4.0))
