"""Small grippers of every kind of coupling, on the PUMA in its cell, as text."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from rack.levels.tables import GripperConfig, RobotConfig, SceneConfig
from tests.levels.arms import ROBOTS, config

PALM = """
<body name="hand" pos="0 0 .05625">
  <inertial mass=".7" pos="0 0 .04" diaginertia=".0008 .0008 .0006"/>
  <geom class="link" name="palm" type="box" size=".05 .03 .02" pos="0 0 .02"/>
  <site name="tcp" pos="0 {tcp} .13" size=".006"/>
  {fingers}
</body>
"""
SLIDE = """
<body name="finger_{side}" pos="0 0 .06">
  <inertial mass=".08" pos="0 0 .04" diaginertia="4e-5 4e-5 1e-5"/>
  <joint name="finger_{side}" type="slide" axis="0 {x}1 0" range="0 .04" damping="20" {armature}/>
  <geom class="pad" name="pad_{side}" type="box" size=".012 .006 .045" pos="0 {x}.006 .045"/>
</body>
"""
TURNING = """
<body name="finger_{side}" pos="0 {x}.05 .05">
  <inertial mass=".05" pos="0 0 .04" diaginertia="4e-5 4e-5 1e-5"/>
  <joint name="finger_{side}" axis="{turn}1 0 0" range="-40 40" damping=".05" {armature}/>
  <geom class="pad" name="pad_{side}" type="box" size=".012 .006 .04" pos="0 0 .05"/>
  {tip}
</body>
"""
TIP = """
<body name="tip_{side}" pos="0 0 .09">
  <inertial mass=".01" pos="0 0 .005" diaginertia="1e-6 1e-6 1e-6"/>
  <joint name="tip_{side}" axis="{turn}1 0 0" range="0 20" damping=".005"/>
  <geom class="pad" name="tip_{side}" type="box" size=".008 .003 .008" pos="0 0 .006"/>
</body>
"""
FIXED = '<geom class="pad" name="jaw" type="box" size=".012 .006 .045" pos="0 -.041 .105"/>'
MIMIC = '<joint joint1="finger_left" joint2="finger_right" solref=".002 1"/>'
SOFT_TENDONS = """
<tendon>
  <fixed name="soft_left" stiffness=".3" springlength=".2">
    <joint joint="finger_left" coef=".4"/><joint joint="tip_left" coef="-.4"/></fixed>
  <fixed name="soft_right" stiffness=".3" springlength=".2">
    <joint joint="finger_right" coef=".4"/><joint joint="tip_right" coef="-.4"/></fixed>
</tendon>
"""
FOUR_BAR_FINGER = """
<body name="crank_{side}" pos="0 {x}.02 .06">
  <inertial mass=".03" pos="0 0 .025" diaginertia="1e-5 1e-5 1e-6"/>
  <joint name="crank_{side}" axis="{turn}1 0 0" range="-10 60" damping=".05" armature=".002"/>
  <geom class="link" name="crank_{side}" type="capsule" fromto="0 0 0 0 0 .05" size=".003"/>
  <body name="tip_{side}" pos="0 0 .05">
    <inertial mass=".03" pos="0 0 .02" diaginertia="1e-5 1e-5 1e-6"/>
    <joint name="tip_{side}" axis="{turn}1 0 0" damping=".005" armature=".001"/>
    <geom class="pad" name="pad_{side}" type="box" size=".012 .006 .03" pos="0 {turn}.014 .02"/>
  </body>
</body>
<body name="rod_{side}" pos="0 {x}.035 .06">
  <inertial mass=".02" pos="0 0 .025" diaginertia="1e-5 1e-5 1e-6"/>
  <joint name="rod_{side}" axis="{turn}1 0 0" damping=".005" armature=".001"/>
  <geom class="link" name="rod_{side}" type="capsule" fromto="0 0 0 0 0 .05" size=".003"/>
</body>
"""
STIFF = 'solref=".002 1" solimp=".99 .999 .001"'
FOUR_BAR_EQUALITY = f"""
<connect name="loop_left" body1="rod_left" body2="tip_left" anchor="0 0 .05" {STIFF}/>
<connect name="loop_right" body1="rod_right" body2="tip_right" anchor="0 0 .05" {STIFF}/>
<joint name="gear" joint1="crank_left" joint2="crank_right" {STIFF}/>
"""
CRANKS = {"joint": "crank_left", "open": 0.6, "closed": 0.0, "force": 2.0, "stiffness": 40.0}
COUPLED_TENDONS = MIMIC + '<tendon tendon1="soft_left"/><tendon tendon1="soft_right"/>'
SLIDING = {"joint": "finger_left", "open": 0.04, "closed": 0.0, "force": 40.0}
ROTARY = {"joint": "finger_left", "open": 0.5, "closed": -0.4, "force": 4.0}


def sides(finger: str, tip: str = "", armature: str = 'armature=".1"') -> str:
    made = []
    for side, x, turn in (("left", "", "-"), ("right", "-", "")):
        top = tip.format(side=side, turn=turn)
        made.append(finger.format(side=side, x=x, turn=turn, tip=top, armature=armature))
    return "".join(made)


def hand(
    folder: Path, fingers: str, gripper: dict[str, Any], equality: str = MIMIC, **parts: Any
) -> tuple[RobotConfig, SceneConfig]:
    """Write the PUMA with a gripper of its own to `folder`; return its robot and scene."""
    before, _, rest = (ROBOTS / "puma560.xml").read_text().partition('<body name="hand"')
    text = (
        before
        + PALM.format(fingers=fingers, tcp=parts.get("tcp", 0.0))
        + rest.split("</body>", 3)[3]
    )
    if "finger_right" not in fingers:
        text = text.replace('<exclude body1="finger_left" body2="finger_right"/>', "")
    start, end = text.index("<equality>"), text.index("</equality>")
    text = text[:start] + "<equality>" + equality + text[end:]
    driven = f'name="grip" joint="{gripper["joint"]}"'
    text = text.replace('name="grip" joint="finger_left"', driven)
    more = f"{parts.get('actuator', '')}</actuator>{parts.get('tendon', '')}"
    text = text.replace("</actuator>", more)
    (folder / "puma560.xml").write_text(text)
    cell_file = folder / "puma560_cell.xml"
    cell_file.write_text((ROBOTS / "puma560_cell.xml").read_text())
    robot, scene = config("puma560")
    changed = {"model": cell_file, "gripper": GripperConfig(actuator="grip", **gripper)}
    return robot.model_copy(update=changed), scene


def independent(folder: Path, **follow: Any) -> tuple[RobotConfig, SceneConfig]:
    """Two fingers, each with its own motor."""
    motor = '<position name="grip_right" joint="finger_right" kp="1000"/>'
    return hand(folder, sides(SLIDE), {**SLIDING, **follow}, "", actuator=motor)


def rotary(folder: Path, armature: str = 'armature=".01"') -> tuple[RobotConfig, SceneConfig]:
    """Two fingers that turn, geared to each other."""
    return hand(folder, sides(TURNING, armature=armature), ROTARY)


def soft(folder: Path, **changed: Any) -> tuple[RobotConfig, SceneConfig]:
    """Two fingers that turn, their tips coupled by tendons to where their stops do not let them."""
    fingers = sides(TURNING, TIP, 'armature=".01"')
    return hand(folder, fingers, {**ROTARY, **changed}, COUPLED_TENDONS, tendon=SOFT_TENDONS)


def four_bar(folder: Path) -> tuple[RobotConfig, SceneConfig]:
    """Closed loops: a parallelogram a finger, two gears.

    The cranks turn outwards by the opening, in rad; rods keep the tips parallel.
    """
    fingers = sides(FOUR_BAR_FINGER)
    return hand(folder, fingers, {**CRANKS, "damping": 1.0}, FOUR_BAR_EQUALITY)


def one_finger(folder: Path) -> tuple[RobotConfig, SceneConfig]:
    """One finger that slides towards a fixed jaw; the tool is next to the jaw."""
    finger = SLIDE.format(side="left", x="", armature='armature=".1"')
    wide = finger.replace('range="0 .04"', 'range="-.035 .04"')
    return hand(folder, wide + FIXED, {**SLIDING, "closed": -0.035}, "", tcp=-0.01)
