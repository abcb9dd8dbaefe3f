"""The same motion by every rack with a PUMA 560: one set of poses in every form, and its
measurement."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

from rack.boards.config import load
from rack.boards.config.files import CONFIGS, read
from rack.levels.planning.ik import InverseKinematics
from rack.levels.robot.cell import build_cell
from rack.tools.lab.benches.systems import motion
from rack.tools.lab.benches.systems.bench import systems
from rack.tools.lab.benches.systems.motion import PosesBench, poses_config, three_poses

TASKS = CONFIGS / "tasks"
LIMITS = ("home", "velocity", "acceleration", "jerk")


def _moving() -> list[str]:
    return [name for name in systems() if poses_config(name) is not None]


def test_every_form_of_the_motion_has_the_same_poses() -> None:
    steps = read(TASKS / "three-motions.toml")["task"]["step"]
    assert [step["joints"] for step in steps if step["do"] == "move"] == three_poses().tolist()
    moved: list[tuple[float, ...]] = []
    runpy.run_path(
        str(TASKS / "three_poses.py"), {"move": moved.append, "wait": lambda request: None}
    )
    assert [list(pose) for pose in moved] == three_poses().tolist()
    tables = CONFIGS / "nist-state-table" / "tables"
    places = read(tables / "three_poses_move.toml")["plan"]["place"]
    order = [step["place"] for step in read(tables / "three_poses_task.toml")["plan"]["step"]]
    config = load("nist-state-table/three-poses")
    assert config.robot is not None
    ik = InverseKinematics(build_cell(config.robot, config.scene, config.clock_ns), 0)
    for name, pose in zip(order, three_poses(), strict=True):
        assert np.abs(ik.tool_at(pose).position - places[name]).max() < 1e-4


def test_all_racks_move_the_same_arm_from_the_same_start_within_the_same_limits() -> None:
    others = {"rccl", "chimera", "brown/one-machine", "ibm", "nist-state-table", "penn"}
    assert {"nasrem", *others} == set(_moving())
    first, *others = (load(poses_config(name) or name).robot for name in _moving())
    for other in others:
        assert all(getattr(other, name) == getattr(first, name) for name in LIMITS)


def test_a_rack_has_a_motion_only_with_a_config_of_its_own() -> None:
    assert poses_config("nasrem") == CONFIGS / "nasrem-three-poses.toml"
    assert (
        poses_config(str(CONFIGS / "rccl" / "rccl.toml")) == CONFIGS / "rccl" / "three-poses.toml"
    )
    assert poses_config("fig2") is None
    assert poses_config("none.toml") is None


@pytest.mark.slow
def test_an_operator_stops_the_arm_on_its_way(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(motion, "LONGEST_S", 4.2)
    monkeypatch.setattr(motion, "STOPPING_S", 1.0)
    bench = PosesBench(
        CONFIGS / "nist-state-table" / "three-poses.toml", "test-three-poses", share=True
    )
    found = bench.measure(tmp_path / "run")
    assert found.reached == len(three_poses())
    assert 0.0 < found.rms_mrad < found.peak_mrad < 2.0
    assert 0.0 < found.tool_mm < 1.0
    assert found.hold is not None
    assert (found.hold.by, found.hold.speed) == ("task", found.emergency.speed)
    # The hold passes five levels, and its ramp is gentler than the brakes.
    assert found.hold.rest_ms is not None
    assert found.emergency.rest_ms is not None
    assert 0.0 < found.emergency.rest_ms < found.hold.rest_ms
