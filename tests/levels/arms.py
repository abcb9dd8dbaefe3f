"""The project's arms and cells for tests, and a small cell as text."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from rack.backplane.message import Message
from rack.levels.arm.plant import Plant
from rack.levels.level import LevelContext
from rack.levels.messages import ArmState
from rack.levels.planning.moves import Situation
from rack.levels.robot.cell import Cell, build_cell, compute_sizes
from rack.levels.tables import RobotConfig, SceneConfig

CLOCK_NS = 2_500_000
ROBOTS = Path(__file__).resolve().parents[2] / "configs" / "robots"

BLOCK = (
    '<body name="block" pos=".6 0 .049"><freejoint/><geom name="block" type="box" size=".05 .05'
    ' .05"/></body>'
)
"""A free body, for the start of `PENDULUM`'s world; its weight presses it 1 mm into the floor."""

PENDULUM = """
<mujoco>
  <compiler angle="radian"/>
  <option timestep="{timestep}"/>
  <worldbody>
    {first}
    <geom name="floor" type="plane" size="2 2 .1"/>
    <body name="upper" pos="0 0 .7">
      <joint name="shoulder" axis="0 1 0" range="-2 2" damping=".5"/>
      <geom name="upper" type="capsule" fromto="0 0 0 .4 0 0" size=".03"/>
      <body name="lower" pos=".45 0 0">
        <joint name="elbow" axis="0 1 0" range="-2 2" damping=".5"/>
        <geom name="lower" type="capsule" fromto="0 0 0 .3 0 0" size=".02"/>
        <site name="tip" pos=".3 0 0"/>
      </body>
    </body>
  </worldbody>
  <tendon><fixed name="cable"><joint joint="elbow" coef=".5"/></fixed></tendon>
  <actuator>{actuators}</actuator>
</mujoco>
"""
MOTORS = '<motor joint="shoulder" ctrlrange="-40 40"/><motor joint="elbow" ctrlrange="-20 20"/>'


def config(name: str) -> tuple[RobotConfig, SceneConfig]:
    """Return robot and scene of one of the project's own arms."""
    tables = tomllib.loads((ROBOTS / f"{name}.toml").read_text())
    tables["robot"]["model"] = ROBOTS / tables["robot"]["model"]
    return RobotConfig(**tables["robot"]), SceneConfig(**tables.get("scene", {}))


def cell(name: str) -> Cell:
    return build_cell(*config(name), CLOCK_NS)


def context(board: str, arm: tuple[RobotConfig, SceneConfig], **fields: Any) -> LevelContext:
    """Return the context of a level, with these fields: else cycles of 1 ms, and no task."""
    given = {"every": 1, "within_cycles": 1, "clock_ns": 1_000_000, "seed": 1, "task": {}} | fields
    return LevelContext(board=board, robot=arm[0], scene=arm[1], **({"sizes": {}} | given))


def save_state(arm: Plant) -> Message:
    state = ArmState.zeros(compute_sizes(arm.cell))
    arm.save(state)
    return state


def find_situation(made: Cell) -> Situation:
    """Return where the objects of a cell are at the start."""
    poses = made.build_start_data().qpos[made.object_qpos[:, None] + np.arange(7)]
    return Situation(poses[:, :3].copy(), poses[:, 3:].copy())


def pendulum(
    folder: Path, actuators: str = MOTORS, first: str = "", timestep: str = ".002", **robot: Any
) -> RobotConfig:
    """Write a two-joint arm to `folder` and return its config, with the keys `robot` changed."""
    model = folder / "pendulum.xml"
    model.write_text(PENDULUM.format(actuators=actuators, first=first, timestep=timestep))
    tables: Mapping[str, Any] = {
        "model": model,
        "joints": ("shoulder", "elbow"),
        "tool": "tip",
        "home": (0.0, 0.5),
        "velocity": (2.0, 3.0),
        "acceleration": (6.0, 9.0),
        "jerk": (60.0, 90.0),
        "enable": "at-start",
    }
    return RobotConfig(**{**tables, **robot})
