"""Racks with the arm on a board of its own, under boards that servo its joints and a level that
swings them."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from tests.levels.arms import ROBOTS

JOINTS = ("j1", "j2", "j3", "j4", "j5", "j6")
TOGETHER: Mapping[str, Mapping[str, Any]] = {"servo": {"gripper": True}}
APART = {f"servo_{joint}": {"joints": [joint], "gripper": joint == JOINTS[-1]} for joint in JOINTS}
"""Parameters of the boards that servo joints, by name: one for all joints, or one each."""


def arm_rack(servos: Mapping[str, Mapping[str, Any]]) -> str:
    """Return a rack with these boards as TOML."""
    names = json.dumps(list(servos))
    boards = [_board(name, 4 + at, params) for at, (name, params) in enumerate(servos.items())]
    return f"""
extends = ["{ROBOTS / "puma560.toml"}"]
format = 2
name = "arm"
python_path = ["{Path(__file__).parent}"]

[clock]
period_ms = 1.0
mode = "lockstep"

[robot]
substeps = 2

[supervision]
max_missed_fraction = 1.0
lockstep_restart_s = 0.1

[board.arm]
slot = 2
core = 1
rate_hz = 1000
above = {names}
executor = "rack.levels.systems.joint_boards:ArmExecutor"

[board.swing]
slot = 3
rate_hz = 50
below = {names}
executor = "joint_levels:Swing"

{"".join(boards)}
"""


def _board(name: str, slot: int, params: Mapping[str, Any]) -> str:
    return f"""
[board.{name}]
slot = {slot}
core = {slot % 2}
rate_hz = 1000
above = "swing"
below = "arm"
executor = "rack.levels.systems.joint_boards:JointServo"
params = {{ {", ".join(f"{key} = {json.dumps(value)}" for key, value in params.items())} }}
"""


def without(board: str) -> dict[str, Mapping[str, Any]]:
    return {name: params for name, params in APART.items() if name != board}


def named(joints: Sequence[str]) -> dict[str, Mapping[str, Any]]:
    """Return `APART` whose first board has other `joints`."""
    return APART | {"servo_j1": {"joints": list(joints)}}
