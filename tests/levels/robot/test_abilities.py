"""What an arm can do at rest, next to the dynamics that its controller evaluates."""

from __future__ import annotations

import numpy as np
import pytest

from rack.boards.config import load
from rack.boards.config.cell import build_rack_cell
from rack.levels.robot.abilities import Abilities, Statics, compute_abilities
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics, Payload


@pytest.fixture(scope="module")
def cell() -> Cell:
    config = load("nasrem")
    assert config.robot is not None
    return build_rack_cell(config)


@pytest.fixture(scope="module")
def found(cell: Cell) -> Abilities:
    return compute_abilities(cell)


def find_worst_load(cell: Cell, payload: float = 0.0) -> tuple[float, int]:
    """Return the largest part of a joint's torque that gravity takes, and the joint."""
    statics = Statics(cell)
    dynamics = Dynamics(cell)
    poses = statics.draw_poses()
    still = np.zeros(len(cell.dof))
    held = Payload(payload, np.zeros(3))
    poses.append(statics.stretch_out(max(poses, key=statics.compute_reach)))
    bias = np.array([dynamics.terms(position, still, held).bias.copy() for position in poses])
    parts = np.abs(bias) / cell.bounds.torque
    joint = int(np.max(parts, axis=0).argmax())
    return float(np.max(parts)), joint


def test_the_payload_uses_up_the_torque_of_one_joint(cell: Cell, found: Abilities) -> None:
    part, joint = find_worst_load(cell)
    assert found.torque_left == pytest.approx(1.0 - part, abs=1e-9)
    assert found.joint == joint
    assert find_worst_load(cell, found.payload)[0] == pytest.approx(1.0, abs=1e-6)
    assert find_worst_load(cell, 0.99 * found.payload)[0] < 1.0


def test_no_joint_extends_the_reach_of_a_stretched_arm(cell: Cell, found: Abilities) -> None:
    # The PUMA 560: upper arm 0.4318 m, forearm 0.4331 m with 20 mm beside it, the tool beyond the
    # wrist, all 0.15 m beside the axis of the first joint.
    wrist = 0.4318 + np.hypot(0.4331, 0.0203)
    assert np.hypot(wrist, 0.15) < found.reach < np.hypot(wrist + 0.25, 0.15)
    statics = Statics(cell)
    poses = statics.draw_poses()
    far = statics.stretch_out(max(poses, key=statics.compute_reach))
    assert statics.compute_reach(far) == pytest.approx(found.reach)
    assert found.reach >= max(map(statics.compute_reach, poses))
    low, high = cell.limits.position.T
    assert ((low - 1e-12 <= far) & (far <= high + 1e-12)).all()
    assert all(((low <= position) & (position <= high)).all() for position in poses)
