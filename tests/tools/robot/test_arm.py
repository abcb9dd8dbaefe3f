"""Tests which joints of a model form the arm, which are passive, and what happens to the rest."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.levels.errors import RobotError
from rack.tools.robot.arm import ArmParts, find_arm
from rack.tools.robot.source import read_source
from tests.tools.command_line import ROOT
from tests.tools.robot.models import drafted, joint, link, urdf, written

DESK_ARM = (ROOT / "configs" / "examples" / "own-arm" / "desk-arm.xml").read_text()
JOINTS = ("waist", "shoulder", "elbow", "roll", "pitch", "twist")
SPRING = 'stiffness="20" damping=".2"'


def rod(name: str, inner: str = "", spring: str = SPRING) -> str:
    """Return a light body on a hinge with this name."""
    return (
        f'<body name="{name} body" pos="0 0 .06"><joint name="{name}" axis="1 0 0" {spring}/>'
        f'<geom type="capsule" size=".008" fromto="0 0 .012 0 0 .04" mass=".01"/>{inner}</body>'
    )


def with_tool(body: str, tool: str) -> str:
    """Return an MJCF arm whose `body` carries a tool."""
    head, name, rest = DESK_ARM.partition(f'<body name="{body}"')
    tag, end, rest = rest.partition(">")
    return head + name + tag + end + tool + rest


def without_motor(name: str) -> str:
    """Return an MJCF arm in which a joint has no actuator."""
    head, _, rest = DESK_ARM.partition("<actuator>")
    lines = [line for line in rest.splitlines() if f'joint="{name}"' not in line]
    return head + "<actuator>" + "\n".join(lines)


def found(folder: Path, text: str, tip: str = "", joints: tuple[str, ...] = ()) -> ArmParts:
    name = "arm.urdf" if "<robot" in text else "arm.xml"
    return find_arm(read_source(written(folder, text, name)).compile_model(), tip, joints)


HOSE = rod("h1", rod("h2", rod("h3", rod("h4", rod("h5", rod("h6", rod("h7", rod("h8"))))))))
FLEXIBLE = with_tool("flange", rod("flex1", rod("flex2")))
FREE = {"limit": '<dynamics damping="0.1"/>', "kind": "continuous"}
TRAY = link("tray", ".02 .02 .02", "0 0 0") + joint(
    "swing", "l6", "tray", "0 0 .05", "1 0 0", **FREE
)
GRIPPER = (
    '<body name="pad1"><joint name="pad1" type="slide" range="0 .04"/><geom size=".01"/></body>'
    '<body name="pad2"><joint name="pad2" type="slide" range="0 .04"/><geom size=".01"/></body>'
)
COUPLING = '<equality><joint joint1="pad1" joint2="pad2"/></equality></mujoco>'
COUPLED_PADS = with_tool("flange", GRIPPER).replace("</mujoco>", COUPLING)
COUPLED_PADS = COUPLED_PADS.replace(
    "</actuator>", '<motor joint="pad1" ctrlrange="-9 9"/></actuator>'
)

UNDRIVEN = FLEXIBLE.partition("<actuator>")[0] + "</mujoco>"
WITH_TRAY, SWING = urdf(gripper=False).replace("</robot>", TRAY + "</robot>"), ("swing",)
PASSIVE = {
    "springs at the tip": (FLEXIBLE, JOINTS, (), ("flex1", "flex2")),
    "a hose longer than the arm": (with_tool("forearm", HOSE), JOINTS, (), ()),
    "a joint of a URDF without effort": (WITH_TRAY, tuple(f"j{k}" for k in range(1, 7)), (), SWING),
    "a base": (without_motor("waist"), JOINTS[1:], (), ()),
    "a finger that follows": (COUPLED_PADS, JOINTS, ("pad1", "pad2"), ()),
    "nothing is driven": (UNDRIVEN, (*JOINTS, "flex1", "flex2"), (), ()),
}


@pytest.mark.parametrize("case", PASSIVE)
def test_the_arm_ends_at_its_last_driven_joint(tmp_path: Path, case: str) -> None:
    text, *parts = PASSIVE[case]
    arm = found(tmp_path, text)
    assert [arm.joints, arm.fingers, arm.passive] == parts


def test_named_joints_are_driven(tmp_path: Path) -> None:
    arm = found(tmp_path, FLEXIBLE, joints=(*JOINTS, "flex1"))
    assert arm.joints == (*JOINTS, "flex1")
    assert (arm.tip, arm.passive) == ("flex1 body", ("flex2",))


@pytest.mark.parametrize(
    ("text", "tip", "names"),
    [(without_motor("elbow"), "", "elbow"), (FLEXIBLE, "flex2 body", "flex1, flex2")],
)
def test_a_passive_joint_within_the_arm_is_refused(
    tmp_path: Path, text: str, tip: str, names: str
) -> None:
    with pytest.raises(RobotError, match=rf"nothing drives {names}, .* --tip .* --joints"):
        found(tmp_path, text, tip)


def test_an_arm_with_too_many_joints_is_refused_with_advice(tmp_path: Path) -> None:
    inner = ""
    for number in range(12, 0, -1):
        inner = rod(f"snake{number}", inner, spring='range="-1 1"')
    motors = "".join(f'<motor joint="snake{k}" ctrlrange="-9 9"/>' for k in range(1, 13))
    text = with_tool("flange", inner).replace("</actuator>", f"{motors}</actuator>")
    with pytest.raises(RobotError, match=r"at most 16 joints, not 18: waist, .* --tip"):
        found(tmp_path, text)


@pytest.mark.slow
def test_springs_stay_springs_and_other_passive_joints_are_held(tmp_path: Path) -> None:
    text = with_tool("flange", rod("flex1") + rod("loose", spring=""))
    made = drafted(tmp_path, written(tmp_path, text, "a.xml"))
    model = made.build_cell().model
    names = [model.joint(k).name for k in range(model.njnt)]
    assert set(names) == {*JOINTS, "flex1"}
    assert model.joint("flex1").stiffness[0] == 20.0
    assert model.nu == len(JOINTS)
    beyond = "passive joints beyond the arm: flex1, loose;"
    assert any(note.startswith(beyond) for note in made.notes)


BASE = 'inertia ixx="{}" iyy="0.01" izz="0.01" ixy="{}"'
UNPHYSICAL = {"unbalanced": (1, 0), "negative": (-1, 0), "full": (0.01, 5)}
BAD_MJCF = '<body name="base"><inertial pos="0 0 0" mass="1" diaginertia="1 .1 .1"/></body>'


@pytest.mark.parametrize("case", [*UNPHYSICAL, "MJCF"])
def test_the_inertia_of_a_base_that_never_moves_does_not_matter(tmp_path: Path, case: str) -> None:
    text = DESK_ARM.replace("<worldbody>", f"<worldbody>{BAD_MJCF}", 1)
    if case in UNPHYSICAL:
        text = urdf().replace(BASE.format(0.01, 0), BASE.format(*UNPHYSICAL[case]), 1)
    assert text not in (urdf(), DESK_ARM)
    name = "arm.xml" if case == "MJCF" else "arm.urdf"
    source = read_source(written(tmp_path, text, name))
    assert source.compile_model().nbody > len(JOINTS)
    assert "physically impossible inertias were balanced" not in source.notes


def test_the_inertia_of_a_body_that_moves_is_still_refused(tmp_path: Path) -> None:
    one = '<link name="l1"><inertial><origin xyz="0 0 0.02"/><mass value="1.0"/>\n<' + BASE
    text = urdf().replace(one.format(0.01, 0), one.format(-1, 0))
    with pytest.raises(RobotError, match=r"positive eigenvalues.*'l1'"):
        read_source(written(tmp_path, text))


LIMITS = 'lower="-2.8" upper="2.8"'


@pytest.mark.slow
@pytest.mark.parametrize("limits", ['lower="0" upper="0"', "", 'lower="2" upper="-2"'])
def test_an_invalid_range_is_reported_and_mujoco_prints_nothing(
    tmp_path: Path, limits: str, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    made = drafted(tmp_path, written(tmp_path, urdf(gripper=False).replace(LIMITS, limits, 3)))
    assert "joints without limits: j1, j2, j3; [robot] position can state them" in made.notes
    assert capfd.readouterr() == ("", "")
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


@pytest.mark.slow
@pytest.mark.parametrize("effort", ["inf", "1e12"])
def test_torques_are_guessed_instead_of_an_infinite_effort(tmp_path: Path, effort: str) -> None:
    text = urdf(gripper=False).replace('effort="60.0"', f'effort="{effort}"')
    made = drafted(tmp_path, written(tmp_path, text))
    assert "torque" in made.guessed
    assert made.robot.torque is not None
    assert max(made.robot.torque) < 1e3
