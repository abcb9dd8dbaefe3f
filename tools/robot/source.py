"""A model from anywhere as an `MjSpec`: MJCF, or URDF by MuJoCo's own parser with its meshes
found."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import mujoco

from rack.levels.errors import RobotError
from rack.levels.robot.model import compile_spec, listed, load_spec, one_line, screen

READ = (".stl", ".obj", ".msh")
"""Meshes that MuJoCo reads."""
COMPILER = {"strippath": "false", "fusestatic": "false", "discardvisual": "true"}
"""Of a URDF: paths are absolute here, and a fixed frame, such as the tool's, stays a body."""
UNBALANCED = "balanceinertia"
SLACK_S = 0.02
"""MuJoCo's time constant of dry friction, which makes it a damper: a light link with the friction
of a large gear, as models for position servos have it, hardly ever meets all of it."""
DRY_SOLREF = (0.001, 1.0)
DRY_SOLIMP = (0.99, 0.99)
"""Of dry friction that is about what the equation of motion says."""


@dataclass
class Source:
    """A parsed model; everything in it has a name."""

    path: Path
    spec: mujoco.MjSpec
    velocity: Mapping[str, float]  # rad/s, of the joints for which a URDF states it
    notes: list[str] = field(default_factory=list)  # what was changed

    def compiled(self) -> mujoco.MjModel:
        """Return the model as it is now. Raises `RobotError`."""
        return compile_spec(self.spec, self.path)


def read_source(path: Path) -> Source:
    """Return a model by its file. Raises `RobotError`, one line, where nothing can be made of
    it."""
    screen(path, path.resolve().parent, set())
    root = ElementTree.parse(path).getroot()
    if root.tag == "mujoco":
        source = Source(path, load_spec(path), {})
    elif root.tag == "robot":
        source = _urdf(path, root)
    else:
        raise RobotError(f"model '{path}': <{root.tag}>; valid: <mujoco> (MJCF), <robot> (URDF)")
    _name_all(source.spec)
    _stiffen(source)
    try:
        source.compiled()
    except RobotError as error:
        if UNBALANCED not in str(error):
            raise
        source.spec.compiler.balanceinertia = True
        source.notes.append("inertias that no body can have are balanced")
        source.compiled()
    return source


def _urdf(path: Path, root: ElementTree.Element) -> Source:
    if any("xacro" in element.tag for element in root.iter()):
        raise RobotError(f"model '{path}': holds xacro; expand it first: xacro IN > arm.urdf")
    named = Counter((e.tag, e.get("name", "")) for e in root if e.tag in ("link", "joint"))
    children = {child.get("link") for child in root.findall("joint/child")}
    roots = [name for tag, name in named if tag == "link" and name not in children]
    twice = [f"{tag} '{name}'" for (tag, name), count in named.items() if count > 1]
    if twice or len(roots) != 1:
        why = f"named twice: {listed(twice)}" if twice else f"roots: {listed(roots)}"
        raise RobotError(f"model '{path}': {why}; one of each is valid")
    notes = []
    if root.find("link/collision") is None:
        notes.append("without collision geometry: what is visible counts")
        for visual in root.findall("link/visual"):
            visual.tag = "collision"
    own = root.find("mujoco/compiler")
    meshes = "." if own is None else own.get("meshdir", ".")
    for link in root.findall("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
        for mesh in link.iter("mesh"):
            mesh.set("filename", str(_mesh(path, mesh.get("filename", ""), meshes)))
    for extension in root.findall("mujoco"):
        root.remove(extension)
    ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler", COMPILER)
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    except ValueError as problem:
        raise RobotError(f"model '{path}': {one_line(problem)}") from None
    limits = {joint.get("name", ""): joint.find("limit") for joint in root.findall("joint")}
    stated = {
        name: float(limit.get("velocity", 0)) for name, limit in limits.items() if limit is not None
    }
    return Source(path, spec, {name: value for name, value in stated.items() if value > 0}, notes)


def _mesh(path: Path, name: str, meshes: str) -> Path:
    """Return the file of a mesh: packages are sought in all folders above the model.

    In place of a mesh that MuJoCo does not read, one of the same name that it does. Raises
    `RobotError`.
    """
    _, is_package, rest = name.rpartition("://")
    folder = path.resolve().parent
    within = rest.partition("/")[2]
    tried = [folder / rest, folder / meshes / Path(rest).name]
    if is_package:
        tried += [above / part for above in folder.parents for part in (rest, within)]
        tried.append(folder / within)
    files = [
        file.with_suffix(suffix)
        for file in tried
        for suffix in (file.suffix, *READ)
        if suffix.lower() in READ
    ]
    found = next((file for file in files if file.is_file()), None)
    if found is None:
        raise RobotError(f"model '{path}': no mesh '{name}'; valid: an {', '.join(READ)} file")
    return found


def _name_all(spec: mujoco.MjSpec) -> None:
    """Name what has no name: a config names bodies, joints and actuators."""
    for kind in ("body", "joint", "actuator"):
        elements = {"body": spec.bodies[1:], "joint": spec.joints, "actuator": spec.actuators}[kind]
        for number, element in enumerate(elements):
            element.name = element.name or f"{kind} {number}"


def _stiffen(source: Source) -> None:
    """Make dry friction what it says, unless the model says how soon it acts."""
    dry = [joint for joint in source.spec.joints if joint.frictionloss > 0.0]
    slack = [joint for joint in dry if joint.solref_friction[0] == SLACK_S]
    for joint in slack:
        joint.solref_friction[:] = DRY_SOLREF
        joint.solimp_friction[:2] = DRY_SOLIMP
    if slack:
        source.notes.append(f"dry friction acts within {1e3 * DRY_SOLREF[0]:g} ms")


def copy_model(source: Source, path: Path) -> None:
    """Write a model as one MJCF file, with copies of its meshes and textures beside it."""
    root = ElementTree.fromstring(source.spec.to_xml())
    folder = source.path.resolve().parent
    compiler = root.find("compiler")
    assert compiler is not None, "MuJoCo writes one"
    names: dict[Path, str] = {}
    for kind, key in (("mesh", "meshdir"), ("texture", "texturedir"), ("hfield", "meshdir")):
        for element in root.iterfind(f"asset/{kind}"):
            for attribute in [name for name in element.attrib if name.startswith("file")]:
                own = folder / compiler.get(key, "") / element.get(attribute, "")
                if own not in names:
                    is_taken = own.name in names.values()
                    names[own] = f"{len(names)}-{own.name}" if is_taken else own.name
                element.set(attribute, names[own])
    for key in ("meshdir", "texturedir"):
        compiler.set(key, "assets")
    assets = path.parent / "assets"
    for own, copied in names.items():
        assets.mkdir(parents=True, exist_ok=True)
        if not (assets / copied).exists():
            shutil.copyfile(own, assets / copied)
    ElementTree.indent(root)
    path.write_text(ElementTree.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
