"""Tests that elements which refer to removed bodies of a model are removed as well."""

from __future__ import annotations

from pathlib import Path

import mujoco
import pytest

from rack.levels.robot.model import load_spec
from rack.tools.robot.arm import fix_joints
from tests.tools.robot.models import written

MODEL = """<mujoco><worldbody><body name="arm"><joint name="j"/><geom name="g" size="1"/>
<site name="s"/>{inside}</body><frame name="f" pos="1 0 0"><body name="cube">
<freejoint name="free"/><geom name="box" size="1"/><site name="spot"/><camera name="eye"/>
<body name="lid"><joint name="hinge"/><geom name="top" size="1"/></body></body></frame>
<body name="hand" mocap="true"/></worldbody>{outside}</mujoco>"""
GONE = {
    "camera": '<camera name="c" mode="targetbody" target="cube"/>',
    "light": '<light mode="targetbody" target="lid"/>',
    "pair": '<contact><pair geom1="g" geom2="box"/></contact>',
    "exclude": '<contact><exclude body1="arm" body2="lid"/></contact>',
    "weld": '<equality><weld body1="arm" body2="hand"/></equality>',
    "connect": '<equality><connect site1="s" site2="spot"/></equality>',
    "joint": '<equality><joint name="e" joint1="j" joint2="hinge"/></equality>',
    "spatial": (
        '<tendon><spatial name="t"><site site="s"/><geom geom="top" sidesite="spot"/>'
        '<site site="s"/></spatial></tendon><actuator><motor name="m" tendon="t"/></actuator>'
        '<sensor><actuatorfrc actuator="m"/><tendonpos tendon="t"/></sensor>'
    ),
    "fixed": (
        '<tendon><fixed name="t"><joint joint="j" coef="1"/><joint joint="hinge" coef="1"/>'
        "</fixed></tendon>"
    ),
    "motor": '<actuator><motor joint="hinge"/></actuator>',
    "site motor": '<actuator><motor site="s" refsite="spot"/></actuator>',
    "crank": ('<actuator><motor slidersite="spot" cranksite="s" cranklength="1"/></actuator>'),
    "adhesion": '<actuator><adhesion body="cube" ctrlrange="0 1"/></actuator>',
    "objname": '<sensor><framepos objtype="body" objname="cube"/></sensor>',
    "frame": '<sensor><framepos objtype="xbody" objname="lid"/></sensor>',
    "refname": (
        '<sensor><framepos objtype="site" objname="s" reftype="body" refname="cube"/></sensor>'
    ),
    "touch": '<sensor><touch site="spot"/></sensor>',
    "distance": '<sensor><distance body1="arm" body2="cube"/></sensor>',
    "contact": '<sensor><contact subtree1="cube" geom2="g"/></sensor>',
    "projection": '<sensor><camprojection site="s" camera="eye"/></sensor>',
    "tuple": (
        '<custom><tuple name="u"><element objtype="body" objname="cube"/></tuple>'
        '<tuple name="w"><element objtype="tuple" objname="u"/></tuple></custom>'
    ),
    "skin": (
        '<deformable><skin vertex="0 0 0 1 0 0 0 1 0" face="0 1 2"><bone body="cube"'
        ' bindpos="0 0 0" bindquat="1 0 0 0" vertid="0 1 2" vertweight="1 1 1"/></skin>'
        "</deformable>"
    ),
}
GONE_WITH_A_JOINT = {
    "equality": '<equality><joint joint1="wrist" joint2="j"/></equality>',
    "leader": '<equality><joint joint1="j" joint2="wrist"/></equality>',
    "motor": '<actuator><motor name="m" joint="wrist"/></actuator>'
    '<sensor><actuatorfrc actuator="m"/></sensor>',
    "tendon": '<tendon><fixed name="t"><joint joint="j" coef="1"/><joint joint="wrist" coef="1"/>'
    '</fixed></tendon><actuator><motor tendon="t"/></actuator>',
    "sensor": '<sensor><jointpos joint="wrist"/></sensor>',
}
KEPT = (
    '<tendon><fixed name="cube"><joint joint="j" coef="1"/></fixed></tendon>'
    '<actuator><motor name="hinge" tendon="cube"/></actuator>'
    '<sensor><actuatorfrc actuator="hinge"/><framepos objtype="body" objname="arm"/></sensor>'
    '<custom><tuple name="lid"><element objtype="body" objname="arm"/></tuple></custom>'
)


COUNTS = ("njnt", "neq", "ntendon", "nu", "nsensor")


def assert_has_one_joint(model: mujoco.MjModel, *counts: str) -> None:
    found = {name: int(getattr(model, name)) for name in counts}
    assert found == dict.fromkeys(found, 0) | {"njnt": 1}


def held(folder: Path, inside: str = "", outside: str = "") -> mujoco.MjModel:
    """Return a model in which everything except its arm was fixed."""
    text = MODEL.format(inside=inside, outside=outside)
    spec = load_spec(written(folder, text, "given.xml"))
    assert sorted(fix_joints(spec, ["j"])) == ["cube", "hand"]
    return load_spec(written(folder, spec.to_xml(), "held.xml")).compile()


@pytest.mark.parametrize("case", GONE)
def test_elements_that_refer_to_a_removed_body_are_removed(tmp_path: Path, case: str) -> None:
    text = GONE[case]
    is_inside = case in ("camera", "light")
    model = held(tmp_path, text if is_inside else "", "" if is_inside else text)
    assert_has_one_joint(model, *COUNTS, "ncam", "nlight", "npair", "nexclude", "ntuple", "nskin")


@pytest.mark.parametrize("case", GONE_WITH_A_JOINT)
def test_elements_that_refer_to_a_fixed_joint_are_removed(tmp_path: Path, case: str) -> None:
    wrist = '<body name="link"><joint name="wrist"/><geom size="1"/></body>'
    model = held(tmp_path, wrist, GONE_WITH_A_JOINT[case])
    assert_has_one_joint(model, *COUNTS)
    assert model.body("link").id > 0


def test_an_element_with_the_name_of_a_removed_one_of_another_kind_stays(tmp_path: Path) -> None:
    model = held(tmp_path, outside=KEPT)
    assert (model.ntendon, model.nu, model.nsensor, model.ntuple) == (1, 1, 2, 1)


def test_a_flex_goes_with_its_bodies(tmp_path: Path) -> None:
    flex = (
        '<deformable><flex name="x" dim="1" body="cube" vertex="0 0 0 0 0 0" element="0 1"'
        ' radius="0.01"/></deformable>'
    )
    assert held(tmp_path, outside=flex).nflex == 0
