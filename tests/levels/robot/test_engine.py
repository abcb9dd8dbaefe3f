"""Views of MuJoCo's memory: they show what the bindings show, at any time."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from rack.levels.robot.engine import build_contact_views, mj_step
from tests.levels.arms import cell


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
