"""Whether a campaign's own instrument works: what says that no limit was violated must say it when one is."""

from __future__ import annotations

import mujoco
from numpy import isfinite

from rack.backplane.message import Message
from rack.boards.config.schema import RackConfig
from rack.levels.arm import SimulatedArm
from rack.levels.messages import ARM_STATE
from rack.levels.robot.cell import STATE, build_cell, sizes
from rack.tools.answer import Failure

FACTOR = 2.0
"""How many times its limit the velocity is that the counter must see."""


def examine(config: RackConfig) -> None:
    """Move every joint at twice its limit for one tick. Raises `Failure` where that is not counted as a violation."""
    if config.robot is None:
        return
    cell = build_cell(config.robot, config.scene, config.clock_ns)
    for joint, (dof, limit) in enumerate(zip(cell.dof, cell.bounds.velocity, strict=True)):
        if not isfinite(limit):
            continue
        arm = SimulatedArm(cell, config.scene, config.clock_ns)
        data, state = cell.start(), Message(ARM_STATE.dtype(sizes(cell)))
        arm.save(state)
        data.qvel[dof] = FACTOR * limit
        mujoco.mj_getState(cell.model, data, state.state, STATE)
        arm.restore(state)
        arm.step(1)
        if not arm.violations:
            name, speed = config.robot.joints[joint], f"{FACTOR * limit:g} rad/s"
            raise Failure(f"violation counter: joint '{name}' at {speed}, twice its limit, is not counted")
