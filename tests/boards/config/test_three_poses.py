"""The same motion by every rack with a PUMA 560: one set of poses in every form."""

from __future__ import annotations

import runpy
from pathlib import Path
from typing import Any

import numpy as np

from rack.boards.config import load
from rack.boards.config.files import CONFIGS, assemble
from rack.levels.planning.ik import InverseKinematics
from rack.levels.robot.cell import build_cell

TASKS = CONFIGS / "tasks"


def tables_of(path: Path) -> dict[str, Any]:
    return assemble(path, (), None).tables


POSES = [action["joints"] for action in tables_of(TASKS / "three-poses.toml")["task"]["action"]]


def test_every_form_of_the_motion_has_the_same_poses() -> None:
    steps = tables_of(TASKS / "three-motions.toml")["task"]["step"]
    assert [step["joints"] for step in steps if step["do"] == "move"] == POSES
    moved: list[tuple[float, ...]] = []
    runpy.run_path(
        str(TASKS / "three_poses.py"), {"move": moved.append, "wait": lambda request: None}
    )
    assert [list(pose) for pose in moved] == POSES
    tables = CONFIGS / "nist-state-table" / "tables"
    places = tables_of(tables / "three_poses_move.toml")["plan"]["place"]
    order = [step["place"] for step in tables_of(tables / "three_poses_task.toml")["plan"]["step"]]
    config = load("nist-state-table/three-poses")
    assert config.robot is not None
    ik = InverseKinematics(build_cell(config.robot, config.scene, config.clock_ns), 0)
    for name, pose in zip(order, np.array(POSES), strict=True):
        assert np.abs(ik.compute_tool_pose(pose).position - places[name]).max() < 1e-4
