"""Files of a model: what is read, and what is refused before MuJoCo hangs on it."""

from __future__ import annotations

import os
import struct
from pathlib import Path

import mujoco
import pytest

from rack.levels.errors import RobotError
from rack.levels.robot.model import compile_spec, load_spec
from rack.levels.robot.model_file import MAX_PARTS

PART = '<body><joint/><geom size=".1"/></body>'
FREE = '<body name="b"><freejoint/><geom size=".1"/>{}</body>'
INERTIAL = '<inertial mass="{}" pos="0 0 0" diaginertia="1 1 1"/>'


def scene(world: str = "", head: str = "") -> str:
    return f"<mujoco>{head}<worldbody>{world}</worldbody></mujoco>"


def write_files(folder: Path, **texts: str) -> Path:
    """Write XML files by their names; return the path of the first."""
    for name, text in texts.items():
        (folder / f"{name}.xml").write_text(text)
    return folder / f"{next(iter(texts))}.xml"


def find_refusal(path: Path) -> str:
    with pytest.raises(RobotError) as refused:
        compile_spec(load_spec(path), path)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def asset(text: str) -> str:
    return scene(head=f"<asset>{text}</asset>")


STRIP = '<compiler strippath="true"/>'
NUMBER = "it must be finite numbers"
PARTS = f"more than {MAX_PARTS} bodies, joints, geoms and sites, with all replicas"
LOOP, ITSELF = "does one include itself?", '<include file="bad.xml"/>'
MANY = '<replicate count="300">{}</replicate>'
ENTITIES = '<!ENTITY a "1"><!ENTITY b "&a;&a;">'
HEAVY = '<body name="b"><freejoint/><geom size=".1" mass="nan"/></body>'
HINGED = '<body name="b"><joint name="j" range="{}"/><geom size=".1"/></body>'
REFUSED = {
    "replicate": (scene(f'<replicate count="100000">{PART}</replicate>'), PARTS),
    "nested replicate": (scene(MANY.format(MANY.format(PART))), PARTS),
    "composite": (scene('<composite type="cable" count="20000 1 1" size="1"/>'), PARTS),
    "flexcomp": (scene('<flexcomp name="f" type="grid" count="100 100 10"/>'), PARTS),
    "flat": (scene(PART * (MAX_PARTS // 3 + 1)), PARTS),
    "deep": (scene("<body>" * 301 + "</body>" * 301), "more than 300 elements within each other"),
    "include loop": (f"<mujoco>{ITSELF}</mujoco>", LOOP),
    "doubled include": (f"<mujoco>{ITSELF}{ITSELF}</mujoco>", LOOP),
    "attach loop": (asset('<model name="m" file="bad.xml"/>'), LOOP),
    "entities": (f'<!DOCTYPE m [{ENTITIES}]><mujoco model="&b;"/>', "line 1 declares an entity"),
    "keys": (scene(head='<size nkey="100000000"/>'), "<size>: nkey = 1e+08; at most"),
    "users": (scene(head='<size nuser_geom="1000000000"/>'), "nuser_geom = 1e+09; at most"),
    "height field": (
        asset('<hfield name="h" nrow="20000" ncol="20000" size="1 1 1 1"/>'),
        "hfield 'h': nrow x ncol = 4e+08; at most",
    ),
    "mass": (scene(FREE.format(INERTIAL.format("nan"))), f"body 'b': mass = 'nan'; {NUMBER}"),
    "other NaN": (scene(FREE.format(INERTIAL.format("nan(7)"))), f"mass = 'nan(7)'; {NUMBER}"),
    "infinite mass": (scene(FREE.format(INERTIAL.format("inf"))), f"mass = 'inf'; {NUMBER}"),
    "mass of a geom": (scene(HEAVY), f"<geom> of body 'b': mass = 'nan'; {NUMBER}"),
    "position": (scene('<body name="b" pos="0 0 -Infinity"/>'), "body 'b': pos = '0 0 -Infinity'"),
    "gravity": (scene(head='<option gravity="0 0 inf"/>'), "<option>: gravity = '0 0 inf'"),
    "range": (scene(HINGED.format("nan 1")), "joint 'j': range = 'nan 1'"),
    "no file": (asset('<mesh name="m" file="x.stl"/>'), "no file 'x.stl'; looked for in /"),
    "device": (asset('<mesh name="m" file="/dev/zero"/>'), "'/dev/zero': not a regular file"),
    "long name": (asset(f'<mesh name="m" file="{"x" * 5000}"/>'), "no file 'xxx"),
    "long include": (scene(head=f'<include file="{"x" * 5000}"/>'), "File name too long"),
    "encoding": ('<?xml version="1.0" encoding="none"?><mujoco/>', "unknown encoding"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_model_on_which_mujoco_would_hang_is_refused_in_one_line(
    tmp_path: Path, case: str
) -> None:
    text, why = REFUSED[case]
    assert why in find_refusal(write_files(tmp_path, bad=text))


@pytest.mark.parametrize(
    "text",
    [
        scene(head='<include file="pipe"/>'),
        asset('<model name="m" file="pipe"/>'),
        asset('<mesh name="m" file="pipe"/>'),
        scene(head=f"{STRIP}<asset><mesh name='m' file='elsewhere/pipe'/></asset>"),
        asset('<texture name="t" type="2d" file="pipe"/>'),
        asset('<texture name="t" type="skybox" fileup="pipe"/>'),
        asset('<hfield name="h" file="pipe" size="1 1 1 1"/>'),
        asset('<skin name="s" file="pipe"/>'),
        scene('<flexcomp name="f" type="mesh" file="pipe"/>'),
        scene(head='<include file="folders.xml"/><asset><mesh name="m" file="pipe"/></asset>'),
    ],
)
def test_a_fifo_in_place_of_any_file_is_refused(tmp_path: Path, text: str) -> None:
    model = write_files(tmp_path, bad=text, folders='<mujoco><compiler assetdir="sub"/></mujoco>')
    folder = tmp_path / "sub" if "folders.xml" in text else tmp_path
    folder.mkdir(exist_ok=True)
    os.mkfifo(folder / "pipe")
    assert f"{folder / 'pipe'}': not a regular file, but a FIFO" in find_refusal(model)
    assert "pipe': not a regular file, but a FIFO" in find_refusal(folder / "pipe")


def test_an_image_that_would_take_all_memory_is_refused(tmp_path: Path) -> None:
    head = b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + struct.pack(">II", 30_000, 30_000)
    (tmp_path / "huge.png").write_bytes(head)
    model = write_files(tmp_path, bad=asset('<texture name="t" type="2d" file="huge.png"/>'))
    assert "huge.png': more than 70000000 pixels" in find_refusal(model)


def test_elements_and_attributes_with_a_prefix_are_ignored(tmp_path: Path) -> None:
    body = '<no:such size="1"><geom size="x"/></no:such><geom size="1" a:b="2" name="{}"/>'
    model = write_files(
        tmp_path,
        main=scene(body.format("own"), '<include file="more.xml"/>'),
        more=f'<mujoco xmlns:c="urn:c" c:d="1">{scene(body.format("more"))[8:]}',
    )
    compiled = compile_spec(load_spec(model), model)
    assert {compiled.geom(k).name for k in range(compiled.ngeom)} == {"own", "more"}


def test_includes_of_one_name_and_attached_models_are_read(tmp_path: Path) -> None:
    for folder in ("sub", "sub/deep", "part"):
        (tmp_path / folder).mkdir()
    cube = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 1 4 3\n"
    (tmp_path / "part" / "cube.obj").write_text(cube)
    geom = '<body name="{0}"><geom name="{0}" size="1"/></body>'
    mesh = '<asset><mesh name="cube" file="cube.obj"/></asset>'
    write_files(tmp_path / "sub", a=scene(geom.format("first"), '<include file="deep/a.xml"/>'))
    write_files(tmp_path / "sub" / "deep", a=scene(geom.format("second")))
    part = '<body name="p"><geom name="g" type="mesh" mesh="cube"/></body>'
    write_files(tmp_path / "part", a=scene(part, mesh))
    world = geom.format("own") + '<attach model="m" body="p" prefix="x_"/>'
    head = '<include file="sub/a.xml"/><asset><model name="m" file="part/a.xml"/></asset>'
    model = write_files(tmp_path, a=scene(world, head))
    compiled = compile_spec(load_spec(model), model)
    names = {compiled.geom(k).name for k in range(compiled.ngeom)}
    assert names == {"own", "first", "second", "x_g"}


def test_replicas_of_what_is_included_or_attached_count(tmp_path: Path) -> None:
    many = '<replicate count="5000">{}</replicate>'
    inner = scene(f'<body name="p">{"<geom/>" * 2}</body>')
    head = '<asset><model name="m" file="part.xml"/></asset>'
    attached = scene(many.format('<attach model="m" body="p" prefix="x"/>'), head)
    included = scene(many.format('<include file="part.xml"/>'))
    for text in (attached, included):
        assert PARTS in find_refusal(write_files(tmp_path, bad=text, part=inner))


def test_a_count_of_parts_that_is_permitted_is_read_in_bounded_time(tmp_path: Path) -> None:
    # Infinite limits are none.
    joint = '<joint name="j" range="-inf inf" limited="false" actuatorfrcrange="-inf inf"/>'
    many = f'<replicate count="300" offset="1 0 0">{PART}</replicate>'
    model = write_files(tmp_path, good=scene(f'{many}<body>{joint}<geom size="1"/></body>'))
    compiled: mujoco.MjModel = compile_spec(load_spec(model), model)
    assert (compiled.ngeom, compiled.njnt) == (301, 301)
