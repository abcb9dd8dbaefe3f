"""A small URDF arm with two fingers, written by the tests."""

from __future__ import annotations

from pathlib import Path

from rack.tools.robot.draft import ArmOptions, Draft, draft_arm
from rack.tools.robot.source import read_source

LENGTHS = (0.1, 0.3, 0.3, 0.1, 0.08, 0.06)  # m
AXES = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
LINK = """<link name="{name}"><inertial><origin xyz="0 0 {half}"/><mass value="{mass}"/>
<inertia ixx="{inertia}" iyy="{inertia}" izz="{inertia}" ixy="0" ixz="0" iyz="0"/></inertial>
<collision><origin xyz="{at}"/><geometry><box size="{size}"/></geometry></collision></link>
"""
JOINT = """<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="{at}"/><axis xyz="{axis}"/>{limit}{mimic}</joint>
"""
LIMIT = '<limit lower="{low}" upper="{high}" effort="{effort}" velocity="2"/>'


def link(name: str, size: str, at: str, mass: float = 1.0, inertia: float = 0.01) -> str:
    return LINK.format(name=name, half=0.02, mass=mass, inertia=inertia, at=at, size=size)


def joint(name: str, parent: str, child: str, at: str, axis: str, **given: str) -> str:
    """Return a joint with `limit`, of `kind`, which may `mimic` another one."""
    more = {"kind": "revolute", "mimic": ""} | given
    return JOINT.format(name=name, parent=parent, child=child, at=at, axis=axis, **more)


def urdf(gripper: bool = True, effort: float = 60.0, mimics: bool = True, jaw: bool = False) -> str:
    """Return an arm of six joints as URDF.

    With `gripper` it has two fingers, of which one mimics the other if `mimics`. With `jaw` it has
    one finger that turns towards a fixed jaw instead.
    """
    parts = [link("base", "0.1 0.1 0.1", "0 0 0")]
    parent, below = "base", 0.05
    for number, (length, axis) in enumerate(zip(LENGTHS, AXES, strict=True), 1):
        limit = LIMIT.format(low=-2.8, high=2.8, effort=effort)
        parts.append(link(f"l{number}", f"0.04 0.04 {length * 0.6}", f"0 0 {length / 2}"))
        parts.append(joint(f"j{number}", parent, f"l{number}", f"0 0 {below}", axis, limit=limit))
        parent, below = f"l{number}", length
    if gripper:
        parts.append(link("hand", "0.04 0.12 0.02", "0 0 0.01", 0.3, 0.001))
        mount = {"limit": "", "kind": "fixed"}
        parts.append(joint("mount", parent, "hand", f"0 0 {below}", "0 0 1", **mount))
        limit = LIMIT.format(low=0, high=0.04, effort=30)
        if jaw:
            # A jaw that is fixed to the hand, and a finger hinged next to it.
            limit, hinge = LIMIT.format(low=0, high=1.0, effort=3), "0 0.012 0.02"
            parts += [
                link("jaw", "0.02 0.01 0.07", "0 -0.005 0.035", 0.1, 0.0001),
                joint("weld", "hand", "jaw", "0 0 0.02", "0 0 1", limit="", kind="fixed"),
                link("thumb", "0.02 0.01 0.07", "0 0.005 0.035", 0.1, 0.0001),
                joint("hinge_of_thumb", "hand", "thumb", hinge, "-1 0 0", limit=limit),
            ]
            return f'<robot name="small">{"".join(parts)}</robot>'
        for side, name in ((1, "left"), (-1, "right")):
            parts.append(link(name, "0.02 0.01 0.06", f"0 {0.005 * side} 0.03", 0.1, 0.0001))
            mimic = '<mimic joint="left_finger"/>' if side < 0 and mimics else ""
            moves = {"limit": limit, "kind": "prismatic", "mimic": mimic}
            parts.append(joint(f"{name}_finger", "hand", name, "0 0 0.02", f"0 {side} 0", **moves))
    return f'<robot name="small">{"".join(parts)}</robot>'


def written(folder: Path, text: str, name: str = "small.urdf") -> Path:
    """Write a model; return its path."""
    path = folder / name
    path.write_text(text)
    return path


def drafted(folder: Path, model: Path) -> Draft:
    """Draft the config of a model into a folder, without options."""
    return draft_arm(read_source(model), ArmOptions(), folder, "drafted")
