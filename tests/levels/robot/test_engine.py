"""Views of MuJoCo's memory: they show what the bindings show, at any time."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from rack.levels.arm.simulation import save_state
from rack.levels.robot.engine import contact_views, mj_step
from rack.levels.robot.state import state_size
from tests.levels.arms import cell


@pytest.mark.parametrize("name", ["puma560", "puma560_crossing"])
def test_views_of_contacts_show_those_of_every_step(name: str) -> None:
    made = cell(name)
    data, seen = made.start(), set()
    views = contact_views(made.model, data)
    for _ in range(600):
        mujoco.mj_step(made.model, data)
        seen.add(data.ncon)
        assert views.number[0] == data.ncon
        assert np.array_equal(views.geoms[: data.ncon], data.contact.geom)
        assert np.array_equal(views.distance[: data.ncon], data.contact.dist)
    assert len(seen) > 1


def test_asking_for_views_changes_no_motion() -> None:
    made = cell("puma560")
    one, other = made.start(), made.start()
    contact_views(made.model, one)
    assert one.ncon == other.ncon
    states = np.zeros((2, state_size(made.model)))
    for data, state in zip((one, other), states, strict=True):
        for _ in range(50):
            mujoco.mj_step(made.model, data)
        save_state(made.model, data, state)
    assert np.array_equal(*states)


def test_a_native_function_is_the_one_of_the_bindings() -> None:
    made = cell("puma560")
    one, other = made.start(), made.start()
    mj_step(made.model._address, one._address)
    mujoco.mj_step(made.model, other)
    assert one.time == made.model.opt.timestep
    assert np.array_equal(one.qpos, other.qpos)
