"""The project's arms and cells for tests, and a small cell as text."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from levels.cell import Cell, build_cell
from levels.robot import RobotConfig
from levels.scene import SceneConfig

CLOCK_NS = 2_500_000
ROBOTS = Path(__file__).resolve().parents[2] / "configs" / "robots"

BLOCK = '<body name="block" pos=".6 0 .049"><freejoint/><geom name="block" type="box" size=".05 .05 .05"/></body>'
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
    """Return the cell of one of the project's own arms."""
    return build_cell(*config(name), CLOCK_NS)


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
    }
    return RobotConfig(**{**tables, **robot})
