"""Two racks whose arms share a body: the arm that touches it last moves it in both."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import cast

import numpy as np
import pytest

from rack.backplane.message import Message
from rack.levels.algebra import Array
from rack.levels.messages import JointCommand
from rack.levels.systems.coordination import SharingServoExecutor
from rack.levels.systems.coordination.shared_bodies import Claim, SharedBodies, SharedBody
from rack.levels.systems.coordination.sharing_arm import SharingArm
from rack.levels.tables import GripperConfig, RobotConfig, SceneConfig
from tests.levels.servo.rig import PERIOD, Course, ServoRig

FINGER = """
<body name="{name}" pos="0 0 -.06">
  <inertial mass=".08" pos="0 0 0" diaginertia="4e-5 4e-5 1e-5"/>
  <joint name="{name}" type="slide" axis="0 {side}1 0" range="0 .04" damping="20" armature=".1"/>
  <geom name="{name}" type="box" size=".012 .006 .045" pos="0 {side}.006 -.035" friction="1.2 .02 .001" condim="4"/>
</body>
"""
HOIST = f"""
<mujoco>
  <option cone="elliptic" impratio="10"/>
  <worldbody>
    <geom name="table" type="box" size=".3 .3 .02" pos="0 0 -.02"/>
    <body name="part" pos="0 .003 .025">
      <freejoint/>
      <geom name="part" type="box" size=".025 .025 .025" density="800" friction="1 .02 .001" condim="4"/>
    </body>
    <body name="hand" pos="0 0 .15">
      <joint name="lift" type="slide" axis="0 0 1" range="-.01 .4" damping="5"/>
      <geom name="palm" type="box" size=".05 .03 .02" mass="2"/>
      <site name="tool" pos="0 0 -.125"/>
      {FINGER.format(name="left", side="")}{FINGER.format(name="right", side="-")}
    </body>
  </worldbody>
  <contact><exclude body1="left" body2="right"/></contact>
  <equality><joint joint1="left" joint2="right" solref=".002 1" solimp=".99 .999 .001"/></equality>
  <actuator><motor joint="lift" ctrlrange="-100 100"/><motor name="grip" joint="left" ctrlrange="-60 60"/></actuator>
</mujoco>
"""
OPEN, CLOSED = 0.04, 0.0
AWAY_M, UP_M = 0.3, 0.1
"""Height of a hand that is out of the way, and of one that has lifted the part."""
MOVE_S = 0.5


class Hoist(ServoRig):
    """One rack: a hand that goes up and down, and a part between its fingers, off the middle."""

    executor = SharingServoExecutor
    outside = {"primitive.command": JointCommand, "lan.shared": SharedBodies}

    def __init__(self, folder: Path, name: str) -> None:
        model = folder / "hoist.xml"
        model.write_text(HOIST)
        gripper = GripperConfig(actuator="grip", joint="left", open=OPEN, closed=CLOSED, force=40.0)
        limits = {"velocity": (2.0,), "acceleration": (20.0,), "jerk": (200.0,)}
        arm = {"model": model, "joints": ("lift",), "tool": "tool", "home": (AWAY_M,)}
        robot, scene = RobotConfig(**arm, **limits, gripper=gripper), {"supports": ("table",)}
        super().__init__(robot, SceneConfig(objects=("part",), **scene), name, shared=("part",))
        self.course = Course(np.array([AWAY_M]), np.array([AWAY_M]), 1.0)
        self.begun = 0

    def go(self, height: float) -> None:
        """Move the hand to a height, m, within `MOVE_S`."""
        self.course = Course(self.course.goal, np.array([height]), MOVE_S)
        self.begun = self.rack.tick

    def tick(self) -> None:
        began = self.begun * 2.5e-3
        self.run(1, lambda time_s: self.course.at(time_s - began))

    @property
    def part(self) -> Array:
        """Pose of this rack's copy of the part, (7,)."""
        return cast(SharingArm, self.servo.arm).read_pose(0)

    @property
    def said(self) -> Message:
        """What the rack said last of the part."""
        return self.rack.read("servo.shared")

    @property
    def claim(self) -> Claim:
        """The claim that stands, as far as this rack says."""
        said = self.said.bodies[0]
        return Claim(int(said["claim"]), bytes(said["owner"]))


class Pair:
    """Two racks that read each other's messages one exchange, 20 ms, later; unless `apart`."""

    def __init__(self, folder: Path) -> None:
        self.alpha, self.beta = Hoist(folder, "alpha"), Hoist(folder, "beta")
        self.apart = False
        self.claims: list[tuple[Claim, Claim]] = []

    def run(self, seconds: float) -> None:
        """Run both; note the claims of both after each tick."""
        for _ in range(round(seconds / 2.5e-3)):
            if self.alpha.rack.tick % PERIOD == 0 and not self.apart:
                said = [(self.alpha, self.beta.said), (self.beta, self.alpha.said)]
                for hoist, message in said:
                    hoist.rack.write("lan.shared", message)
            for hoist in (self.alpha, self.beta):
                hoist.tick()
            self.claims.append((self.alpha.claim, self.beta.claim))

    def lift(self, hoist: Hoist) -> None:
        """Let one hand come down, take the part and lift it."""
        self._grip_below(hoist, CLOSED, 0.4, UP_M)

    def put_down(self, hoist: Hoist) -> None:
        """Let it put the part down, let go, and get out of the way."""
        self._grip_below(hoist, OPEN, 0.3, AWAY_M)

    def _grip_below(self, hoist: Hoist, opening: float, seconds: float, height: float) -> None:
        hoist.go(0.0)
        self.run(0.6)
        hoist.command.opening = opening
        self.run(seconds)
        hoist.go(height)
        self.run(0.6)


@pytest.fixture
def pair(tmp_path: Path) -> Iterator[Pair]:
    pair = Pair(tmp_path)
    pair.run(0.1)
    yield pair
    for hoist in (pair.alpha, pair.beta):
        assert hoist.status.touches == hoist.status.violations == 0


@pytest.mark.thorough
def test_a_hand_over_and_back_has_one_owner_at_a_time(pair: Pair) -> None:
    assert pair.alpha.claim == pair.beta.claim == Claim(), "nobody has touched it yet"
    np.testing.assert_array_equal(pair.alpha.part, pair.beta.part)
    turns = (pair.alpha, pair.beta), (pair.beta, pair.alpha)
    for number, (hoist, other) in enumerate(turns, start=1):
        pair.lift(hoist)
        assert hoist.claim == other.claim == Claim(number, hoist.servo.context.rack.encode())
        assert hoist.part[2] == pytest.approx(0.025 + UP_M, abs=0.003)
        np.testing.assert_allclose(other.part, hoist.part, atol=1e-4)
        pair.put_down(hoist)
        assert not hoist.said.bodies[0]["touched"]
        np.testing.assert_allclose(other.part, hoist.part, atol=1e-4)
    differing = [(a, b) for a, b in pair.claims if a != b]
    assert len(differing) <= 2 * 2 * PERIOD, "after two exchanges both know"
    # Until then one claim is the greater.
    assert all(abs(a.number - b.number) == 1 for a, b in differing)


def test_the_name_decides_between_two_arms_that_take_the_part_at_once(pair: Pair) -> None:
    hoists = pair.alpha, pair.beta
    for hoist in hoists:
        hoist.go(0.0)
    pair.run(0.6)
    for hoist in hoists:
        hoist.command.opening = CLOSED
    pair.run(0.4)
    assert (Claim(1, b"alpha"), Claim(1, b"beta")) in pair.claims
    assert pair.alpha.claim == pair.beta.claim == Claim(1, b"beta")


@pytest.mark.slow
@pytest.mark.parametrize("restarted", ["alpha", pytest.param("beta", marks=pytest.mark.thorough)])
def test_the_part_stays_in_place_during_a_restart(pair: Pair, restarted: str) -> None:
    pair.lift(pair.alpha)
    hoist: Hoist = getattr(pair, restarted)
    before = hoist.part
    pair.apart = hoist is pair.beta  # without the other's word it has to remember by itself
    pair.run(0.1)
    np.testing.assert_allclose(hoist.part, before, atol=1e-3 if hoist is pair.alpha else 1e-12)
    hoist.rack.lose("servo", 12)
    pair.run(0.3)
    assert hoist.claim == Claim(1, b"alpha")
    np.testing.assert_allclose(hoist.part, before, atol=1e-3 if hoist is pair.alpha else 1e-12)
    pair.apart = False
    pair.put_down(pair.alpha)
    pair.lift(pair.beta)
    assert pair.alpha.claim == pair.beta.claim == Claim(2, b"beta")


def word(rack: bytes, claim: Claim, x: float) -> Message:
    """Return a message of a rack: the claim that it knows, and where its copy is."""
    message = SharedBodies.zeros({})
    message.rack = rack
    speaker = SharedBody(b"part", rack, claim)
    speaker.write_entry(message.bodies[0], np.array([x, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]))
    return message


def test_only_the_owner_reports_the_pose_of_a_body() -> None:
    body = SharedBody(b"part", b"alpha")
    owned = Claim(3, b"beta")
    # The claim is news, from wherever.
    assert body.process_message(word(b"gamma", owned, 1.0)) is not None
    assert body.claim == owned
    assert body.process_message(word(b"gamma", owned, 2.0)) is None, "its copy is late"
    told = body.process_message(word(b"beta", owned, 3.0))
    assert told is not None
    assert told[0] == 3.0
