"""What an arm can do at rest, next to the dynamics that its controller evaluates."""

from __future__ import annotations

import numpy as np
import pytest

from rack.boards.config import load
from rack.boards.config.cell import built_cell
from rack.levels.robot.abilities import Abilities, Statics, abilities
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics, Payload


@pytest.fixture(scope="module")
def cell() -> Cell:
    config = load("nasrem")
    assert config.robot is not None
    return built_cell(config)


@pytest.fixture(scope="module")
def found(cell: Cell) -> Abilities:
    return abilities(cell)


def worst(cell: Cell, payload: float = 0.0) -> tuple[float, int]:
    """Return the largest part of a joint's torque that gravity takes, by the controller's own
    model, and the joint."""
    statics = Statics(cell)
    dynamics = Dynamics(cell)
    poses = statics.poses()
    still = np.zeros(len(cell.dof))
    held = Payload(payload, np.zeros(3))
    poses.append(statics.stretched(max(poses, key=statics.distance)))
    parts = [
        np.abs(dynamics.terms(position, still, held).bias) / cell.bounds.torque
        for position in poses
    ]
    joint = int(np.max(parts, axis=0).argmax())
    return float(np.max(parts)), joint


def test_the_payload_takes_all_of_one_joints_torque(cell: Cell, found: Abilities) -> None:
    part, joint = worst(cell)
    assert found.left == pytest.approx(1.0 - part, abs=1e-9)
    assert found.joint == joint
    assert worst(cell, found.payload)[0] == pytest.approx(1.0, abs=1e-6)
    assert worst(cell, 0.99 * found.payload)[0] < 1.0


def test_stretched_out_no_single_joint_reaches_farther(cell: Cell, found: Abilities) -> None:
    # The PUMA 560: upper arm 0.4318 m, forearm 0.4331 m with 20 mm beside it, the tool beyond the
    # wrist, all 0.15 m beside the axis of the first joint.
    wrist = 0.4318 + np.hypot(0.4331, 0.0203)
    assert np.hypot(wrist, 0.15) < found.reach < np.hypot(wrist + 0.25, 0.15)
    statics = Statics(cell)
    poses = statics.poses()
    far = statics.stretched(max(poses, key=statics.distance))
    assert statics.distance(far) == pytest.approx(found.reach)
    assert found.reach >= max(map(statics.distance, poses))
    low, high = cell.limits.position.T
    assert ((low - 1e-12 <= far) & (far <= high + 1e-12)).all()
    assert all(((low <= position) & (position <= high)).all() for position in poses)
