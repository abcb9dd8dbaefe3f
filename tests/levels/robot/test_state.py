"""What lies at rest sleeps, wakes when it is moved, and is saved and restored as it is."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from rack.levels.arm import SimulatedArm
from rack.levels.arm.simulation import enable_sleep
from rack.levels.robot.engine import SLEEP, build_contact_views, mj_step
from rack.levels.tables import MotionConfig, PushConfig, SceneConfig
from tests.levels.arms import CLOCK_NS, cell, config, save_state

PUSH = PushConfig(body="block1", at=0.5, seconds=0.1, force=(0.0, 2.0, 0.0))
PUSHED_TICK = 200
END_TICK = 400
FALLING_ASLEEP_TICK = 4


class Sleepless(SimulatedArm):
    sleeps = False


def build_arm(kind: type[SimulatedArm] = SimulatedArm) -> SimulatedArm:
    """Return an arm that stands still above a block that is pushed once."""
    _, scene = config("puma560")
    return kind(cell("puma560"), scene.model_copy(update={"push": (PUSH,)}), CLOCK_NS)


def read_state(arm: SimulatedArm) -> list[float]:
    found: list[float] = save_state(arm).state.tolist()
    return found


def list_asleep(arm: SimulatedArm) -> list[bool]:
    """Return, by tree of bodies, the arm first, whether it sleeps."""
    return [tree >= 0 for tree in read_state(arm)[-arm.cell.model.ntree :]]


def read_places(arm: SimulatedArm) -> np.ndarray:
    return np.array(arm._data.qpos[arm.cell.object_qpos[:, None] + np.arange(3)])


def test_objects_sleep_until_one_is_pushed_and_end_where_they_would_without_sleep() -> None:
    arm, other = build_arm(), build_arm(Sleepless)
    start = read_places(arm)
    assert list_asleep(arm) == [False] * 4
    arm.step(PUSHED_TICK)
    assert list_asleep(arm) == [False, True, True, True]
    arm.step(1)
    assert list_asleep(arm) == [False, False, True, True]
    arm.step(END_TICK - PUSHED_TICK - 1)
    assert list_asleep(arm) == [False, True, True, True]
    other.step(END_TICK)
    assert list_asleep(other) == [False] * 4
    assert np.abs(read_places(arm) - start).max() > 0.08
    assert read_places(arm) == pytest.approx(read_places(other), abs=0.005)


@pytest.mark.parametrize("tick", [FALLING_ASLEEP_TICK, 100, PUSHED_TICK + 5, END_TICK - 60])
def test_a_restored_cell_continues_bit_for_bit_asleep_or_awake(tick: int) -> None:
    arm, again = build_arm(), build_arm()
    arm.step(tick)
    again.step(PUSHED_TICK + 3)  # where others are awake
    again.restore(save_state(arm))
    assert read_state(again) == read_state(arm)
    for each in (arm, again):
        each.step(END_TICK - tick)
    assert read_state(again) == read_state(arm)


def test_nothing_sleeps_where_an_obstacle_moves() -> None:
    made = cell("puma560_crossing")
    _, scene = config("puma560_crossing")
    (name, *_) = scene.obstacles
    motion = MotionConfig(body=name, at=0.0, to=(0.0, 0.0, 0.0), speed=0.1)
    moving = SceneConfig(obstacles=(name,), motion=(motion,))
    assert not enable_sleep(made.model, moving).opt.enableflags & SLEEP
    assert enable_sleep(made.model, SceneConfig()).opt.enableflags & SLEEP
    assert not made.model.opt.enableflags & SLEEP


def test_nothing_sleeps_in_a_model_for_which_mujoco_would_end_the_process() -> None:
    tied = mujoco.MjModel.from_xml_string("""
        <mujoco><worldbody>
          <body><joint name="a"/><geom size=".1"/></body>
          <body pos="1 0 0"><joint name="b"/><geom size=".1"/></body>
        </worldbody>
        <tendon><fixed name="t"><joint joint="a" coef="1"/></fixed>
          <fixed name="u"><joint joint="b" coef="1"/></fixed></tendon>
        <equality><tendon tendon1="t" tendon2="u"/></equality></mujoco>""")
    assert not enable_sleep(tied, SceneConfig()).opt.enableflags & SLEEP


@pytest.mark.parametrize(
    ("timestep", "gravity", "sleeps"),
    [(5e-4, 9.81, True), (2e-5, 9.81, False), (5e-4, 0.5, False), (5e-4, 0.0, False)],
)
def test_nothing_sleeps_in_flight(timestep: float, gravity: float, sleeps: bool) -> None:
    falling = mujoco.MjModel.from_xml_string(f"""
        <mujoco><option timestep="{timestep}" gravity="0 0 {-gravity}"/><worldbody>
          <body><freejoint/><geom size=".1"/></body></worldbody></mujoco>""")
    model = enable_sleep(falling, SceneConfig())
    assert bool(model.opt.enableflags & SLEEP) is sleeps
    data = mujoco.MjData(model)
    data.qvel[2] = 0.2 * gravity
    for _ in range(round(0.3 / timestep)):
        mujoco.mj_step(model, data)
    assert data.qvel[2] == pytest.approx(-0.1 * gravity, abs=1e-3)


@pytest.mark.parametrize("name", ["puma560", "puma560_crossing"])
def test_views_of_contacts_show_those_of_every_step(name: str) -> None:
    made = cell(name)
    data, other, seen = made.build_start_data(), made.build_start_data(), set()
    views = build_contact_views(made.model, data)
    for _ in range(600):
        mj_step(made.model._address, data._address)
        mujoco.mj_step(made.model, other)
        seen.add(data.ncon)
        assert views.number[0] == data.ncon
        assert np.array_equal(views.geoms[: data.ncon], data.contact.geom)
        assert np.array_equal(views.distance[: data.ncon], data.contact.dist)
    assert len(seen) > 1
    # Views change no motion, and the native function is that of the bindings.
    assert (data.time, data.qpos.tolist()) == (other.time, other.qpos.tolist())
