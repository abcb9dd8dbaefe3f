"""What a `[robot]` table may leave to its model, and what it may add to it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rack.boards.config import load
from rack.boards.config.cell import build_rack_cell
from rack.boards.errors import ConfigError
from tests.tools.command_line import ROOT

MODEL = ROOT / "configs" / "examples" / "own-arm" / "desk-arm.xml"
TABLE = """
format = 2
name = "lean"
extends = ["nasrem"]
[robot]
model = "arm.xml"
velocity = [2.0, 2.0, 2.5, 4.0, 4.0, 5.0]
acceleration = [4.0, 4.0, 6.0, 12.0, 12.0, 12.0]
jerk = [40.0, 40.0, 60.0, 120.0, 120.0, 120.0]
{more}
[scene]
objects = []
supports = []
[task]
action = []
"""
KEYS = '<keyframe><key name="ready" qpos="0 -.6 1.8 0 1.9416 0"/></keyframe></mujoco>'


def config(folder: Path, more: str = "", model: str = "") -> Any:
    (folder / "arm.xml").write_text(model or MODEL.read_text().replace("</mujoco>", KEYS))
    path = folder / "lean.toml"
    path.write_text(TABLE.format(more=more))
    return load(path)


def test_joints_tool_and_home_come_from_actuators_sites_and_keyframe(tmp_path: Path) -> None:
    robot = config(tmp_path).robot
    assert robot.joints == ("waist", "shoulder", "elbow", "roll", "pitch", "twist")
    assert (robot.tool, robot.home) == ("tip", (0.0, -0.6, 1.8, 0.0, 1.9416, 0.0))


def test_a_model_without_actuators_must_have_its_joints_named(tmp_path: Path) -> None:
    text = MODEL.read_text()
    bare = text[: text.index("<actuator>")] + "</mujoco>"
    why = r"robot\.joints: name the joints, because none in the model"
    with pytest.raises(ConfigError, match=why):
        config(tmp_path, model=bare)


def test_a_tool_may_be_a_body_and_an_offset(tmp_path: Path) -> None:
    offset = 'tool = "flange"\n[robot.tool_offset]\nposition = [0.0, 0.0, 0.13]'
    own = build_rack_cell(config(tmp_path, offset))
    site = build_rack_cell(config(tmp_path))
    ends = [built.build_start_data().site_xpos[built.tool] for built in (own, site)]
    assert np.linalg.norm(ends[0] - ends[1]) == pytest.approx(0.1)
    with pytest.raises(Exception, match=r"no site 'tcp' in the model; it has: tip; bodies: world"):
        build_rack_cell(config(tmp_path, 'tool = "tcp"'))
    with pytest.raises(ConfigError, match=r"'velocities' is not a key of \[robot\]"):
        config(tmp_path, 'guessed = ["home", "velocities"]')
