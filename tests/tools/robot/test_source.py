"""Tests reading of URDFs: what is accepted, what is noted, and refusals in one line."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from rack.levels.errors import RobotError
from rack.tools.robot.source import Source, read_source
from tests.tools.robot.models import urdf, written

MODEL = urdf(gripper=False)
TAIL = "</robot>"
NEWLINE = "\n"
CUBE = "v 0 0 0\nv 0.1 0 0\nv 0 0.1 0\nv 0 0 0.1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"


def read(folder: Path, text: str) -> Source:
    return read_source(written(folder, text))


def refusal(folder: Path, text: str) -> str:
    with pytest.raises(RobotError) as refused:
        read(folder, text)
    assert "\n" not in str(refused.value)
    return str(refused.value)


VELOCITY = "it must be a finite number, such as 2.5, from 0 to 1e+09"
NUMBERS = {
    "comma": ('velocity="2"', 'velocity="2,5"', f"velocity = '2,5'; {VELOCITY}"),
    "empty": ('velocity="2"', 'velocity=""', f"velocity = ''; {VELOCITY}"),
    "xacro": ('velocity="2"', 'velocity="${vmax}"', f"velocity = '${{vmax}}'; {VELOCITY}; expand"),
    "NaN": ('velocity="2"', 'velocity="nan"', f"velocity = 'nan'; {VELOCITY}"),
    "too fast": ('velocity="2"', 'velocity="1e300"', f"velocity = '1e300'; {VELOCITY}"),
    "two": ('velocity="2"', 'velocity="2 3"', f"velocity = '2 3'; {VELOCITY}"),
    "lower": ('lower="-2.8"', 'lower="-2.8 rad"', "<limit> of joint 'j1': lower = '-2.8 rad'"),
    "upper": ('upper="2.8"', 'upper="inf"', "<limit> of joint 'j1': upper = 'inf'"),
    "effort": ('effort="60.0"', 'effort="60 N"', "<limit> of joint 'j1': effort = '60 N'"),
    "mass": ('mass value="1.0"', 'mass value="nan"', "<mass> of link 'base': value = 'nan'"),
    "inertia": ('ixx="0.01"', 'ixx="inf"', "<inertia> of link 'base': ixx = 'inf'"),
    "place": ('xyz="0 0 0.05"', 'xyz="0 0"', "xyz = '0 0'; it must be 3 finite numbers"),
    "axis": ('axis xyz="0 0 1"', 'axis xyz="z"', "<axis> of joint 'j1': xyz = 'z'"),
    "size": ('size="0.1 0.1 0.1"', 'size="0,1 0,1 0,1"', "<box> of link 'base': size = '0,1"),
    "friction": ("<axis", '<dynamics friction=""/><axis', "of joint 'j1': friction = ''"),
    "mimic": ("<axis", '<mimic joint="j2" multiplier="x"/><axis', "joint 'j1': multiplier = 'x'"),
}


@pytest.mark.parametrize("case", NUMBERS)
def test_an_invalid_number_is_named_with_its_joint_or_link(tmp_path: Path, case: str) -> None:
    good, bad, why = NUMBERS[case]
    assert good in MODEL
    assert why in refusal(tmp_path, MODEL.replace(good, bad, 1))


def test_numbers_of_other_programs_and_infinite_efforts_are_read(tmp_path: Path) -> None:
    text = MODEL.replace('effort="60.0"', 'effort="inf"')
    other = '<gazebo><velocity value="fast"/></gazebo><sensor name="s"><origin xyz="x"/></sensor>'
    assert read(tmp_path, text.replace(TAIL, other + TAIL)).velocity["j1"] == 2.0


@pytest.mark.parametrize(
    "extra",
    [
        "<gazebo><controller:manager name='m'/></gazebo>",
        "<a:link name='base'/>",
        "<xacro:property name='a' value='1'/>",
    ],
)
def test_elements_and_attributes_with_a_prefix_are_ignored(tmp_path: Path, extra: str) -> None:
    text = MODEL.replace(TAIL, extra + TAIL).replace("<mass", '<mass drake:value="x"')
    assert len(read(tmp_path, text).spec.joints) == 6


MESH = '<geometry><mesh filename="{}"/></geometry>'
BOX = '<geometry><box size="0.1 0.1 0.1"/></geometry>'
STRUCTURE = {
    "world": (
        '<joint name="w" type="fixed"><parent link="world"/><child link="base"/></joint>',
        "no link 'world', to which a joint refers; add <link name=\"world\"/>",
    ),
    "xacro": (
        '\n\n<xacro:arm prefix="a"/>',
        f"line {MODEL.count(NEWLINE) + 3} holds <xacro:arm>; expand it first",
    ),
}


@pytest.mark.parametrize("case", STRUCTURE)
def test_missing_parts_of_a_urdf_are_reported_with_advice(tmp_path: Path, case: str) -> None:
    extra, why = STRUCTURE[case]
    assert why in refusal(tmp_path, MODEL.replace(TAIL, extra + TAIL))


def with_visuals(links: range) -> str:
    """Return an arm in which some links have only a visual shape."""
    text = MODEL
    for k in links:
        start, end = text.index(f'<link name="l{k}">'), text.index(f'<joint name="j{k}"')
        link = text[start:end].replace("collision>", "visual>")
        text = text[:start] + link + text[end:]
    return text


def test_visible_shapes_are_used_in_planning_with_a_note(tmp_path: Path) -> None:
    source = read(tmp_path, with_visuals(range(3, 6)))
    assert source.notes == ["no <collision>, so planning uses the visible shapes: l3, l4, l5"]
    model = source.compile_model()
    shown = [int(model.body(f"l{k}").geomnum[0]) for k in range(1, 7)]
    assert shown == [1] * 6
    assert model.geom_contype.all()


def test_links_without_inertia_are_named(tmp_path: Path) -> None:
    text = re.sub(r'(<link name="l[12]">)<inertial>.*?</inertial>', r"\1", MODEL, flags=re.DOTALL)
    notes = read(tmp_path, text).notes
    why = "no <inertial>, so the mass is computed from the shapes with the density of water"
    assert notes == [f"{why}: l1, l2"]


def test_unreadable_visuals_are_noted_or_refused(tmp_path: Path) -> None:
    (tmp_path / "l.dae").touch()
    mesh = MESH.format("l.dae")
    head, _, tail = with_visuals(range(6, 7)).rpartition("<geometry><box")
    text = head + mesh + tail.partition("</geometry>")[2]
    why = "no <collision> and no mesh that can be read, so no shape in planning: l6"
    assert read(tmp_path, text).notes == [why]
    nothing = re.sub("<geometry>.*?</geometry>", mesh, MODEL.replace("collision>", "visual>"))
    assert "as Collada and the like are not read" in refusal(tmp_path, nothing)


def test_a_missing_mesh_is_reported_with_all_searched_places(tmp_path: Path) -> None:
    why = refusal(tmp_path, MODEL.replace(BOX, MESH.format("package://arm/meshes/b.stl")))
    assert "no mesh 'package://arm/meshes/b.stl': looked for as " in why
    for place in ("arm/meshes/b.stl", "b.stl"):
        assert str(tmp_path / place) in why


def test_collada_is_refused_unless_a_readable_mesh_is_beside_it(tmp_path: Path) -> None:
    text = MODEL.replace(BOX, MESH.format("b.dae"))
    (tmp_path / "b.dae").touch()
    why = f"convert '{tmp_path / 'b.dae'}', in its folder, as Collada and the like are not read"
    assert why in refusal(tmp_path, text)
    (tmp_path / "b.obj").write_text(CUBE)
    assert read(tmp_path, text).compile_model().nmesh == 1


def test_a_fifo_in_place_of_a_mesh_is_refused(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "b.stl")
    why = refusal(tmp_path, MODEL.replace(BOX, MESH.format("b.stl")))
    assert why.endswith("b.stl': not a regular file, but a FIFO")


def test_a_planar_joint_below_the_base_is_fixed_with_a_note(tmp_path: Path) -> None:
    joint = '<joint name="drive" type="planar"><parent link="map"/><child link="base"/></joint>'
    source = read(tmp_path, MODEL.replace(TAIL, f'<link name="map"/>{joint}{TAIL}'))
    assert [one.name for one in source.spec.joints] == [f"j{k}" for k in range(1, 7)]
    assert source.notes == ["planar joint 'drive' is fixed: a mobile base does not move"]


def test_a_model_in_millimetres_gets_a_note(tmp_path: Path) -> None:
    text = re.sub('xyz="0 0 (0.3)"', 'xyz="0 0 300"', MODEL)
    assert read(tmp_path, text).notes == ["parts are 300 m apart: is the model in millimetres?"]
