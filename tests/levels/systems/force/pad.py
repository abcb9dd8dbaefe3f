"""The PUMA with a pad on a wrist sensor, over a table and before a wall, for tests of forces."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rack.levels.tables import RobotConfig, SceneConfig, SensorConfig, WristConfig
from tests.levels.arms import ROBOTS, config

PAD = """
<body name="tool" pos="0 0 .05625">
  <inertial mass="1.1" pos="0 0 .05" diaginertia=".0015 .0015 .0008"/>
  <site name="sensor"/>
  <site name="tcp" pos="0 0 .13"/>
  <geom class="link" name="stem" type="cylinder" fromto="0 0 0 0 0 .10" size=".015"/>
  <geom name="pad" type="sphere" size=".03" pos="0 0 .10" density="0" priority="1" friction="{friction}" {contact}/>
</body>
"""
WORLD = """
<body name="stand"><site name="base"/><geom name="stand" size=".01"/></body>
<geom name="table" type="box" size=".4 .6 .02" pos=".60 0 .43"/>
<geom name="wall" type="box" size=".02 .3 .3" pos=".78 0 .75"/>
"""
SOFT = 'solref="-1000 -20" solimp=".5 .5 .001"'
"""A rubber pad. In MuJoCo a contact at rest has the stiffness m k d / (1 - d), with the inertia m
that it sees, the first number of `solref` for -k, and of `solimp` for d: with the usual d of 0.95
it would be 19 times as stiff."""
SENSORS = """
<sensor>
  <force name="wrist_force" site="{force}" cutoff="{range}"/>
  <torque name="wrist_torque" site="{torque}" cutoff="20"/>
</sensor>
"""
GRIP = '<motor name="grip" joint="finger_left" ctrlrange="-60 60"/>'
WRIST = {"force": "wrist_force", "torque": "wrist_torque", "most_force": 60.0, "most_torque": 8.0}


def pad(
    folder: Path,
    contact: str = SOFT,
    friction: float = 0.3,
    sites: tuple[str, str] = ("sensor", "sensor"),
    reach: float = 150.0,
    resolution: float = 0.0,
    **wrist: Any,
) -> tuple[RobotConfig, SceneConfig]:
    """Write the model to `folder`; return its config, with the keys `wrist` changed.

    `resolution` is that of the encoders, rad; `reach` the range of the sensor, N.
    """
    before, _, rest = (ROBOTS / "puma560.xml").read_text().partition('<body name="hand"')
    after = rest.split("</body>", 3)[3].replace('body2="hand"', 'body2="tool"')
    for gone in ('<exclude body1="finger_left" body2="finger_right"/>', GRIP):
        after = after.replace(gone, "")
    after = after.replace("</worldbody>", WORLD + "</worldbody>")
    equality, actuator = after.index("<equality>"), after.index("<actuator>")
    sensors = SENSORS.format(force=sites[0], torque=sites[1], range=reach)
    after = after[:equality] + sensors + after[actuator:]
    body = PAD.format(contact=contact, friction=f"{friction:g}")
    (folder / "pad.xml").write_text(before + body + after)
    robot, _ = config("puma560")
    changes = {
        "model": folder / "pad.xml",
        "gripper": None,
        "substeps": 4,
        "wrist": WristConfig(**{**WRIST, **wrist}),
        "sensors": SensorConfig(resolution=resolution),
    }
    return robot.model_copy(update=changes), SceneConfig(supports=("table", "wall"))
