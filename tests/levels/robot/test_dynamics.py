"""The equation of motion against published numbers, and against MuJoCo's own motion."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

from rack.levels.planning.ik import InverseKinematics
from rack.levels.robot.cell import Cell, build_cell
from rack.levels.robot.dynamics import DISABLED_PARTS, Dynamics, Payload
from rack.levels.tables import SceneConfig
from tests.levels.arms import CLOCK_NS, ROBOTS, cell, config

DATA = Path(__file__).parent / "data"
PUMA: dict[str, Any] = json.loads((DATA / "puma560_oracle.json").read_text())
K1607: dict[str, Any] = json.loads((DATA / "k1607_vectors.json").read_text())


@pytest.fixture(scope="module")
def puma(tmp_path_factory: pytest.TempPathFactory) -> Cell:
    """The PUMA without hand and friction, as in the published numbers."""
    tree = ElementTree.parse(ROBOTS / "puma560.xml")
    root = tree.getroot()
    for name, parent in [(n, p) for p in root.iter() for n in list(p)]:
        bodies = name.get("body1"), name.get("body2")
        of_hand = name.get("name") in ("hand", "grip") or "hand" in bodies
        fingers = "finger" in name.get("body1", "") + name.get("joint1", "")
        if of_hand or fingers:
            parent.remove(name)
    for joint in root.iter("joint"):
        joint.attrib.pop("damping", None)
    model = tmp_path_factory.mktemp("puma") / "bare.xml"
    tree.write(model)
    changes = {"model": model, "tool": "wrist", "gripper": None}
    robot = config("puma560")[0].model_copy(update=changes)
    return build_cell(robot, SceneConfig(), CLOCK_NS)


@pytest.mark.parametrize("pose", PUMA)
def test_puma_kinematics_match_the_robotics_toolbox(puma: Cell, pose: str) -> None:
    tool = InverseKinematics(puma, 0).compute_tool_pose(np.array(PUMA[pose]["q"]))
    wanted, rotation = np.array(PUMA[pose]["T"]), np.zeros(9)
    mujoco.mju_quat2Mat(rotation, tool.quaternion)
    assert tool.position == pytest.approx(wanted[:3, 3], abs=1e-12)
    assert rotation == pytest.approx(wanted[:3, :3].ravel(), abs=1e-10)


@pytest.mark.parametrize("pose", PUMA)
def test_puma_torques_match_the_robotics_toolbox(puma: Cell, pose: str) -> None:
    dynamics, published = Dynamics(puma), PUMA[pose]
    q, qd, qdd = (np.array(published[name]) for name in ("q", "qd", "qdd"))
    inertia, bias = (x.copy() for x in dynamics.terms(q, np.zeros(6)))
    assert bias == pytest.approx(published["grav"], abs=1e-9)
    assert inertia == pytest.approx(np.array(published["M"]), abs=1e-9)
    moving = dynamics.terms(q, qd).bias
    assert moving - bias == pytest.approx(published["Cqd"], abs=1e-8)
    assert inertia @ qdd + moving == pytest.approx(published["rne_nofric"], abs=1e-8)


@pytest.mark.parametrize("row", range(len(K1607["vectors"]["gravity"])))
def test_k1607_gravity_matches_the_published_vectors(row: int) -> None:
    q, torque = K1607["vectors"]["gravity"][row]
    bias = Dynamics(cell("k1607")).terms(np.array(q), np.zeros(7)).bias
    assert -bias == pytest.approx(torque, abs=1e-3)


@pytest.mark.parametrize("name", ["puma560", "k1607"])
def test_torques_from_the_equation_of_motion_give_the_requested_acceleration(name: str) -> None:
    made = cell(name)
    dynamics, rng = Dynamics(made), np.random.default_rng(3)
    joints = len(made.qpos)
    qd, wanted = rng.uniform(-1, 1, joints), rng.uniform(-2, 2, joints)
    inertia, bias = dynamics.terms(made.home, qd)
    data = made.build_start_data()
    data.qvel[made.dof] = qd
    friction = made.model.dof_frictionloss[made.dof] * np.sign(qd)
    data.ctrl[made.actuators] = inertia @ wanted + bias + friction
    if made.gripper is not None:  # fingers that do not fly apart
        data.qvel[made.gripper.dof] = 0.0
    mujoco.mj_forward(made.model, data)
    assert data.qacc[made.dof] == pytest.approx(wanted, abs=0.05)


def test_terms_do_not_depend_on_earlier_evaluations(puma: Cell) -> None:
    rng = np.random.default_rng(4)
    asked, fresh = Dynamics(puma), Dynamics(puma)
    q, qd = rng.uniform(-1, 1, (2, 6))
    for _ in range(5):
        asked.terms(*rng.uniform(-1, 1, (2, 6)), Payload(2.0, rng.uniform(-0.1, 0.1, 3)))
    first, second = asked.terms(q, qd), fresh.terms(q, qd)
    assert np.array_equal(first.inertia, second.inertia)
    assert np.array_equal(first.bias, second.bias)
    # Nor on what became of the answer.
    bias, known = first.bias.copy(), asked.newest.copy()
    for array in first:
        array[:] = 7.0
    assert np.array_equal(asked.newest, known)
    assert np.array_equal(asked.terms(q, qd).bias, bias)


@pytest.mark.parametrize("name", ["puma560", "k1607"])
def test_terms_equal_a_full_forward_pass_bit_for_bit(name: str) -> None:
    made, rng = cell(name), np.random.default_rng(9)
    dynamics, data = Dynamics(made), made.build_start_data()
    full = np.zeros((made.model.nv, made.model.nv))
    made.model.opt.disableflags |= int(DISABLED_PARTS)
    for _ in range(5):
        data.qpos[made.qpos], data.qvel[made.dof] = rng.uniform(-1, 1, (2, len(made.qpos)))
        inertia, bias = dynamics.terms(data.qpos[made.qpos], data.qvel[made.dof])
        mujoco.mj_forward(made.model, data)
        mujoco.mj_fullM(made.model, data, full)
        assert np.array_equal(inertia, full[np.ix_(made.dof, made.dof)])
        assert np.array_equal(bias, (data.qfrc_bias - data.qfrc_passive)[made.dof])


def test_a_payload_acts_like_a_small_mass_fixed_to_the_tool(tmp_path: Path) -> None:
    robot, _ = config("puma560")
    mass, offset = 1.7, np.array([0.02, -0.03, 0.05])
    text = (ROBOTS / "puma560.xml").read_text()
    x, y, z = offset + np.array([0.0, 0.0, 0.13])  # the tool's site on the hand
    inertia = f'<inertial mass="{mass}" pos="0 0 0" diaginertia="1e-9 1e-9 1e-9"/>'
    ball = f'<body pos="{x} {y} {z}">{inertia}</body>'
    loaded = tmp_path / "loaded.xml"
    loaded.write_text(text.replace('<site name="tcp"', ball + '<site name="tcp"'))
    models = loaded, ROBOTS / "puma560.xml"
    robots = (robot.model_copy(update={"model": model}) for model in models)
    heavy, bare = (Dynamics(build_cell(one, SceneConfig(), CLOCK_NS)) for one in robots)
    q, qd = np.random.default_rng(5).uniform(-1, 1, (2, 6))
    carried, welded = bare.terms(q, qd, Payload(mass, offset)), heavy.terms(q, qd)
    assert carried.inertia == pytest.approx(welded.inertia, abs=1e-7)
    assert carried.bias == pytest.approx(welded.bias, abs=1e-7)
