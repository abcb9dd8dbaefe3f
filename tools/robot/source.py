"""Reads a model file, MJCF or URDF, as an `MjSpec`, and finds the meshes of a URDF."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from xml.etree import ElementTree

import mujoco

from rack.levels.errors import RobotError
from rack.levels.robot.model import compile_spec, format_names, format_one_line, load_spec
from rack.levels.robot.model_file import ModelReader, check_asset, find_file

MESH_FORMATS = (".stl", ".obj", ".msh")
"""Formats of meshes that MuJoCo reads."""
URDF_COMPILER = {"strippath": "false", "fusestatic": "false", "discardvisual": "true"}
"""Compiler settings for a URDF.

Paths are absolute, and a fixed frame, such as the tool's, stays a body.
"""
UNBALANCED = "balanceinertia"
"""Part of MuJoCo's error message for an impossible inertia. It names the setting that helps."""
DEFAULT_FRICTION_TIME_S = 0.02
"""MuJoCo's default time constant of dry friction.

It turns dry friction into damping: a light link behind a large gear hardly ever gets all of it.
"""
LARGE_M = 20.0
"""A model with larger parts than this is probably in millimetres."""
DRY_SOLREF = (0.001, 1.0)
DRY_SOLIMP = (0.99, 0.99)
"""Solver parameters with which dry friction nearly follows the equation of motion."""


@dataclass
class Source:
    """A parsed model. All of its bodies, joints and actuators have names."""

    path: Path
    spec: mujoco.MjSpec
    velocity: Mapping[str, float]  # rad/s, of the joints for which a URDF states it
    notes: list[str] = field(default_factory=list)  # changes that were made, one sentence each

    def compile_model(self) -> mujoco.MjModel:
        """Compile the model in its current state. Raises `RobotError` if it is invalid."""
        return compile_spec(self.spec, self.path)


def read_source(path: Path) -> Source:
    """Read a model file. Raises `RobotError` with a one-line message if it cannot be read."""
    root = ModelReader(path).root
    if root.tag == "mujoco":
        source = Source(path, load_spec(path), {})
    elif root.tag == "robot":
        source = _convert_urdf(path, root)
    else:
        raise RobotError(f"model '{path}': <{root.tag}>; valid: <mujoco> (MJCF), <robot> (URDF)")
    # A config refers to bodies, joints and actuators by name, so give a name to all of them.
    named = {
        "body": source.spec.bodies[1:],
        "joint": source.spec.joints,
        "actuator": source.spec.actuators,
    }
    for kind, elements in named.items():
        for number, element in enumerate(elements):
            element.name = element.name or f"{kind} {number}"
    # Let dry friction act at once, unless the model states a time constant.
    dry = [joint for joint in source.spec.joints if joint.frictionloss > 0.0]
    slack = [joint for joint in dry if joint.solref_friction[0] == DEFAULT_FRICTION_TIME_S]
    for joint in slack:
        joint.solref_friction[:] = DRY_SOLREF
        joint.solimp_friction[:2] = DRY_SOLIMP
    if slack:
        source.notes.append(f"dry friction acts within {1e3 * DRY_SOLREF[0]:g} ms")
    try:
        model = source.compile_model()
    except RobotError as error:
        if UNBALANCED not in str(error):
            raise
        source.spec.compiler.balanceinertia = True
        source.notes.append("physically impossible inertias were balanced")
        model = source.compile_model()
    size = max(model.geom_rbound.max(initial=0.0), abs(model.body_pos).max())
    if size > LARGE_M:
        source.notes.append(f"parts are {size:.4g} m apart: is the model in millimetres?")
    return source


def _convert_urdf(path: Path, root: ElementTree.Element) -> Source:
    """Convert a URDF, and fix its planar joints. Raises `RobotError` if it is invalid."""
    _check_tree(path, root)
    notes = _prepare_shapes(path, root)
    for joint in root.findall("joint[@type='planar']"):
        joint.set("type", "fixed")
        notes.append(f"planar joint '{joint.get('name')}' is fixed: a mobile base does not move")
    for extension in root.findall("mujoco"):
        root.remove(extension)
    ElementTree.SubElement(ElementTree.SubElement(root, "mujoco"), "compiler", URDF_COMPILER)
    try:
        spec = mujoco.MjSpec.from_string(ElementTree.tostring(root, encoding="unicode"))
    except ValueError as problem:
        raise RobotError(f"model '{path}': {format_one_line(problem)}") from None
    limits = {joint.get("name", ""): joint.find("limit") for joint in root.findall("joint")}
    stated = {
        name: float(limit.get("velocity", 0)) for name, limit in limits.items() if limit is not None
    }
    return Source(path, spec, {name: value for name, value in stated.items() if value > 0}, notes)


def _check_tree(path: Path, root: ElementTree.Element) -> None:
    """Raise `RobotError` unless a URDF is a tree with one root and unique names."""
    named = Counter((e.tag, e.get("name", "")) for e in root if e.tag in ("link", "joint"))
    links = [name for tag, name in named if tag == "link"]
    children = [child.get("link", "") for child in root.findall("joint/child")]
    parents = [parent.get("link", "") for parent in root.findall("joint/parent")]
    twice = [f"{tag} '{name}'" for (tag, name), count in named.items() if count > 1]
    roots = [name for name in links if name not in children]
    if unknown := [name for name in parents + children if name not in links]:
        why = f"no link '{unknown[0]}', to which a joint refers; add <link name=\"{unknown[0]}\"/>"
    elif twice:
        why = f"named twice: {format_names(twice)}; one of each is valid"
    elif len(roots) != 1:
        why = f"roots: {format_names(roots)}; one is valid"
    else:
        return
    raise RobotError(f"model '{path}': {why}")


def _prepare_shapes(path: Path, root: ElementTree.Element) -> list[str]:
    """Find the meshes of a URDF. A link without collision shapes gets its visible shapes as such.

    Returns notes for the user. Raises `RobotError` if a mesh of a collision shape cannot be read,
    or if no link has a shape that can be read.
    """
    compiler = root.find("mujoco/compiler")
    folder = "." if compiler is None else compiler.get("meshdir", ".")
    children = {child.get("link", "") for child in root.findall("joint/child")}
    visible: list[str] = []
    unreadable: dict[str, RobotError] = {}
    for link in root.findall("link"):
        name = link.get("name", "")
        is_only_visible = link.find("collision") is None and link.find("visual") is not None
        for visual in link.findall("visual"):
            if is_only_visible:
                visual.tag = "collision"
            else:
                link.remove(visual)
        try:
            for mesh in link.iter("mesh"):
                mesh.set("filename", str(_find_mesh(path, mesh.get("filename", ""), folder)))
            if is_only_visible:
                visible.append(name)
        except RobotError as problem:
            if not is_only_visible:
                raise
            unreadable[name] = problem
            for shape in link.findall("collision"):
                link.remove(shape)
    if unreadable and root.find("link/collision") is None:
        raise next(iter(unreadable.values()))
    massless = [
        link.get("name", "")
        for link in root.findall("link[collision]")
        if link.get("name") in children and link.find("inertial") is None
    ]
    notes = {
        "no <collision>, so planning uses the visible shapes": visible,
        "no <collision> and no mesh that can be read, so no shape in planning": [*unreadable],
        "no <inertial>, so the mass is computed from the shapes with the density of water": (
            massless
        ),
    }
    return [f"{why}: {format_names(names)}" for why, names in notes.items() if names]


def _find_mesh(path: Path, name: str, meshes: str) -> Path:
    """Find the file of a mesh. Raises `RobotError` if there is none or it cannot be used.

    Packages are searched for in all folders above the model. For a mesh in a format that MuJoCo
    does not read, a file of the same name in another format is accepted.
    """
    _, is_package, rest = name.rpartition("://")
    folder = path.resolve().parent
    within = rest.partition("/")[2]
    tried = [folder / rest, folder / meshes / Path(rest).name]
    if is_package:
        tried += [above / relative for above in folder.parents for relative in (rest, within)]
        tried.append(folder / within)
    files = [
        file.with_suffix(suffix)
        for file in tried
        for suffix in (file.suffix, *MESH_FORMATS)
        if suffix.lower() in MESH_FORMATS
    ]
    mesh_file = find_file(files)
    if mesh_file is None:
        other = find_file(tried)
        why = f"looked for as {format_names([*dict.fromkeys(map(str, tried))], most=6)}"
        if other is not None:
            why = f"convert '{other}', in its folder, as Collada and the like are not read"
        raise RobotError(
            f"model '{path}': no mesh '{name}': {why}; valid: {', '.join(MESH_FORMATS)}"
        )
    check_asset(mesh_file, path)
    return mesh_file


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
                asset = folder / compiler.get(key, "") / element.get(attribute, "")
                if asset not in names:
                    is_taken = asset.name in names.values()
                    names[asset] = f"{len(names)}-{asset.name}" if is_taken else asset.name
                element.set(attribute, names[asset])
    for key in ("meshdir", "texturedir"):
        compiler.set(key, "assets")
    assets = path.parent / "assets"
    for asset, copied in names.items():
        assets.mkdir(parents=True, exist_ok=True)
        if not (assets / copied).exists():
            shutil.copyfile(asset, assets / copied)
    ElementTree.indent(root)
    path.write_text(ElementTree.tostring(root, encoding="unicode") + "\n", encoding="utf-8")
