"""Tests the limits and loops that `rack robot new` chooses for an arm's joints."""

from __future__ import annotations

import tomllib
from pathlib import Path

import mujoco
import numpy as np
import pytest

from rack.levels.errors import Refused
from rack.levels.robot.dynamics import Dynamics
from rack.tools.robot import assignment
from rack.tools.robot.assignment import Assignment
from rack.tools.robot.draft import EMPTY_SCENE
from rack.tools.robot.folder import format_config
from tests.tools.robot.models import drafted, urdf, written

pytestmark = pytest.mark.slow

DRY_N_M = 30.0
SPEED = 0.3  # rad/s
STIFF = round((1.0 / (0.002 * (0.05 + 0.01))) ** 0.5, 1)
"""rad/s: 1 N m holds the last link, of 0.01 kg m2 and the least armature, 2 mrad from its goal."""


def with_friction(text: str) -> str:
    return text.replace("<axis", f'<dynamics friction="{DRY_N_M}"/><axis')


def test_dry_friction_of_light_links_follows_the_equation_of_motion(tmp_path: Path) -> None:
    made = drafted(tmp_path, written(tmp_path, with_friction(urdf(gripper=False))))
    assert "dry friction acts within 1 ms" in made.notes
    cell = made.build_cell()
    dynamics = Dynamics(cell)
    velocity = np.full(6, SPEED)
    friction = dynamics.friction(velocity)
    assert friction == pytest.approx(np.full(6, DRY_N_M), rel=1e-3)
    data = cell.build_start_data()
    data.qvel[cell.dof] = velocity
    data.qfrc_applied[cell.dof] = dynamics.terms(cell.home, velocity).bias + friction
    mujoco.mj_forward(cell.model, data)
    # A steady motion takes the torque that the servo level expects.
    assert -data.qfrc_constraint[cell.dof] == pytest.approx(friction, rel=0.01)


@pytest.mark.parametrize(("friction", "bandwidth"), [(0.2, None), (1.0, STIFF), (30.0, 100.0)])
def test_a_loop_is_stiff_enough_for_joints_to_rest_at_their_goals(
    friction: float, bandwidth: float | None, tmp_path: Path
) -> None:
    model = with_friction(urdf(gripper=False)).replace(str(DRY_N_M), str(friction))
    made = drafted(tmp_path, written(tmp_path, model))
    assert made.limits.bandwidth == bandwidth
    text = format_config(made, Assignment(EMPTY_SCENE, [], "nothing"), "drafted", made.model)
    servo = {"servo": {"params": {"bandwidth": bandwidth}}}
    assert tomllib.loads(text).get("board", {}) == (servo if bandwidth else {})


def test_a_rehearsal_ends_with_its_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = drafted(tmp_path, written(tmp_path, urdf()))
    home = [{"do": "home"}]
    assignment._rehearse_program(made, EMPTY_SCENE, home)
    monkeypatch.setattr(assignment, "REHEARSAL_S", 0.0)
    with pytest.raises(Refused, match="no way found in 0 s of processor time"):
        assignment._rehearse_program(made, EMPTY_SCENE, home)
