"""The world model: poses, velocities, and a revision that rises when motion starts or ends."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
import pytest

from rack.backplane.message import Message
from rack.levels.algebra import Array
from rack.levels.messages import Scene
from rack.levels.world import WorldModel
from tests.levels.arms import config
from tests.levels.box import lose_some
from tests.levels.lockstep import CLOCK_NS, BoardSpec, Lockstep

PERIOD = 8
TICK_S = CLOCK_NS * 1e-9
START = np.array([[0.5, 0.3, 0.475], [0.6, 0.3, 0.475], [0.5, -0.3, 0.5]])
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])
Poses = Callable[[float], tuple[Array, Array]]


class WorldRig:
    """Runs the world model on scenes that are a function of time."""

    def __init__(self) -> None:
        board = BoardSpec("world", PERIOD, WorldModel)
        self.rack = Lockstep([board], *config("puma560"), outside={"servo.scene": Scene})

    @property
    def model(self) -> Message:
        return cast(Message, self.rack.tasks["world"].written["model"])

    def run(self, seconds: float, poses: Poses | None) -> list[int]:
        """Run with a scene of `poses` every tick, if given; return the revisions seen."""
        revisions = [self.model.revision]
        for _ in range(round(seconds / TICK_S)):
            if poses is not None:
                position, quaternion = poses(self.rack.tick * TICK_S)
                self.rack.show("servo.scene", position=position, quaternion=quaternion)
            self.rack.step()
            if self.model.revision != revisions[-1]:
                revisions.append(self.model.revision)
        return revisions


def resting(_: float) -> tuple[Array, Array]:
    return START, np.tile(UPRIGHT, (3, 1))


def sliding(begin_s: float, end_s: float, speed: float) -> Poses:
    """The first object slides along x between two times."""

    def poses(time_s: float) -> tuple[Array, Array]:
        moved = START.copy()
        moved[0, 0] += speed * (min(max(time_s, begin_s), end_s) - begin_s)
        return moved, np.tile(UPRIGHT, (3, 1))

    return poses


def test_bodies_at_rest_keep_one_revision_and_have_no_velocity() -> None:
    rig, rng = WorldRig(), np.random.default_rng(2)
    # There is no model before the first scene.
    assert rig.run(0.2, None) == [0]
    assert not rig.model.quaternion.any()
    rig.run(0.1, resting)
    first = rig.model.revision
    tiles = np.tile(UPRIGHT, (3, 1))
    assert rig.run(2.0, lambda _: (START + rng.normal(0.0, 2e-5, (3, 3)), tiles)) == [first]
    assert not rig.model.velocity.any()
    assert rig.model.position == pytest.approx(START, abs=2e-4)


def test_the_revision_rises_when_a_body_starts_and_when_it_rests_again() -> None:
    rig, slide = WorldRig(), sliding(1.0, 1.5, 0.25)
    revisions = rig.run(1.4, slide)
    velocity = np.array([[0.25, 0, 0], [0, 0, 0], [0, 0, 0]])
    assert rig.model.velocity == pytest.approx(velocity, abs=1e-9)
    assert rig.model.position[0, 0] == pytest.approx(0.5 + 0.25 * 0.4, abs=0.26 * PERIOD * TICK_S)
    revisions += rig.run(1.6, slide)[1:]
    assert len(revisions) == 4  # none, first scene, start, rest
    assert revisions == sorted(revisions)
    assert revisions[2] * TICK_S == pytest.approx(1.0, abs=0.05)
    assert revisions[3] * TICK_S == pytest.approx(1.7, abs=0.05)
    # One that creeps is seen to have moved too.
    assert len(WorldRig().run(3.0, sliding(0.5, 10.0, 0.004))) > 2


def test_a_restarted_board_shows_its_last_model_and_age_until_it_sees_again() -> None:
    rig = WorldRig()
    rig.run(1.0, resting)
    before = rig.model.revision
    rig.rack.disturb("servo.scene", lose_some(1.0, seed=1), round(0.2 / TICK_S))
    rig.rack.lose("world", round(0.1 / TICK_S))
    rig.run(0.2, resting)
    assert rig.model.position == pytest.approx(START)
    assert rig.model.revision == before
    assert 0 < rig.model.sensed <= round(1.0 / TICK_S)
    rig.run(0.1, resting)
    assert rig.rack.tick - rig.model.sensed <= PERIOD
    assert rig.model.revision > before
