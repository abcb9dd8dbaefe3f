"""Something to do for a drafted arm: a table with two blocks that it moves, or a tour of poses;
either is rehearsed as the task level will.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco
import numpy as np

from rack.levels.algebra import Array, norm
from rack.levels.errors import Refused, RobotError
from rack.levels.messages import Error
from rack.levels.motion.path import Path
from rack.levels.planning.ik import MAX_RESTARTS, InverseKinematics
from rack.levels.planning.motion_planner import MotionPlanner
from rack.levels.planning.moves import Situation
from rack.levels.planning.pose import pointing, pose
from rack.levels.robot.abilities import Statics
from rack.levels.robot.cell import Cell, check_start
from rack.levels.tables import SceneConfig
from rack.levels.task.actions import LEANING_RESTARTS, rehearse
from rack.levels.task.grasps import FULL_ORIENTATION, QUARTERS
from rack.levels.task.program import DOWN, TaskConfig
from rack.levels.task.rehearsal import Rehearsal
from rack.tools.console.answer import Document
from rack.tools.robot.draft import LEAST_PART, NOTHING, Draft, FittedGripper, find_home, poses

SEED = 1990
"""That of `nasrem`."""
HEIGHTS = (0.05, 0.2, -0.1, 0.4, 0.6)
DISTANCES = (0.55, 0.7, 0.42, 0.34)
FRONTS = (0.0, 0.5 * np.pi, -0.5 * np.pi, np.pi)
"""Tables that are tried: height over the base and distance of the middle in parts of the reach;
direction, rad."""
SPOTS = ((-0.04, -0.1), (0.04, -0.26), (-0.04, 0.1), (0.04, 0.26))
"""Where the blocks stand, and where they go: outward and sideways from the middle, likewise."""
TABLES = 4
"""Tables on which the whole task is rehearsed, at most."""
SEARCH_S = 15.0
"""Processor time in which a table is sought, about: then a tour has to do."""
REHEARSAL_S = 10.0
"""Processor time for the task on one table; those that served took at most 1.6 s. Where there is no
way between the blocks, all others are tried at 2 s each."""
STOPS = 4
"""Poses of a tour."""
OBJECTS = ("block1", "block2")
TABLE = "table"
"""Names; a model that has them gets others."""
MOST_BLOCK_M = 0.05
DENSITY = 400.0  # kg/m3
CLEAR_M = 0.008
"""Between fingers and table when a block is taken."""
LOOSE_M = 0.004
"""More, where it is a guess how fingers follow: with less Robotiq's 140 touches the table."""


class TableSpot(NamedTuple):
    """A table that may do."""

    top: float  # m
    front: float  # rad
    places: list[Array]  # four, (2,), m
    middle: Array  # (2,), m


@dataclass(frozen=True)
class Assignment:
    """A scene and a program for it."""

    scene: SceneConfig
    actions: list[Document]
    kind: str


def lay_out(made: Draft) -> Assignment:
    """Return what the arm can do, its home fit for that; the model gets table and blocks. Raises
    `RobotError`.
    """
    if made.gripper is not None:
        found = _pick_and_place(made, made.gripper)
        if isinstance(found, Assignment):
            return found
        made.notes.append(f"no transfer, but a tour of poses: {found}")
    return _tour(made)


def _pick_and_place(made: Draft, gripper: FittedGripper) -> Assignment | str:
    cell = made.cell()
    jaws = gripper.fingertips
    width = min(jaws.block, MOST_BLOCK_M)
    # The tool is in the middle of a block that stands, its fingers clear of the table.
    clear = CLEAR_M + LOOSE_M * bool(gripper.config.follow)
    half = 0.5 * np.array([width, width, max(width, 2.0 * (jaws.below + clear))])
    reach = _reach(cell)
    lift = round(min(0.1, 0.12 * reach), 3)
    why = "no table on which the tool comes down to blocks"
    spots = (spot for spot in _spots(cell, reach) if _serves(cell, spot, half[2], lift))
    taken = {body.name for body in made.spec.bodies} | {geom.name for geom in made.spec.geoms}
    table, *blocks = (f"{name} of rack" if name in taken else name for name in (TABLE, *OBJECTS))
    scene = SceneConfig(objects=tuple(blocks), supports=(table,))
    for spot in itertools.islice(spots, TABLES):
        added = _furnish(made.spec, scene, spot, half, reach)
        made.write_model()
        height = round(spot.top + half[2], 4)
        actions: list[Document] = [
            {
                "do": "transfer",
                "object": name,
                "to": [*place.round(4).tolist(), height],
                "lift": lift,
            }
            for name, place in zip(blocks, spot.places[2:], strict=True)
        ]
        actions.append({"do": "home"})
        try:
            made.home = find_home(made, scene, [np.array(action["to"]) for action in actions[:-1]])
            _rehearse(made, scene, actions)
            return Assignment(scene, actions, "a table, two blocks to move")
        except (Refused, RobotError) as refused:
            why = str(refused)
        for body in added:
            made.spec.delete(body)
        made.write_model()
    made.home = find_home(made)
    return why


def _reach(cell: Cell) -> float:
    """Return the largest distance of the tool from the base, m."""
    ik = InverseKinematics(cell, SEED)
    base = _base(cell)
    return max(norm(ik.tool_at(q).position - base) for q in poses(cell))


def _base(cell: Cell) -> Array:
    """Return where the arm stands, (3,), m: below its first joint, at its root's height."""
    data = cell.start()
    joint = cell.model.dof_jntid[cell.dof[0]]
    root = cell.model.body_rootid[cell.model.jnt_bodyid[joint]]
    return np.array([*data.xanchor[joint][:2], data.xpos[root][2]])


def _spots(cell: Cell, reach: float) -> Iterator[TableSpot]:
    base = _base(cell)
    end = time.process_time() + SEARCH_S
    for height, distance, front in itertools.product(HEIGHTS, DISTANCES, FRONTS):
        if time.process_time() > end:
            return
        out = np.array([np.cos(front), np.sin(front)])
        side = np.array([-out[1], out[0]])
        middle = base[:2] + distance * reach * out
        places = [middle + reach * (a * out + b * side) for a, b in SPOTS]
        yield TableSpot(round(base[2] + height * reach, 3), front, places, middle)


def _serves(cell: Cell, spot: TableSpot, half: float, lift: float) -> bool:
    """Say whether the tool comes down to every place."""
    ik = InverseKinematics(cell, SEED)
    # Of fewer joints one has to be chosen less luckily.
    restarts = MAX_RESTARTS if len(cell.qpos) >= FULL_ORIENTATION else LEANING_RESTARTS

    def is_reached(place: Array) -> bool:
        for quarter in QUARTERS:
            turned = pointing(DOWN, -(spot.front + 0.5 * np.pi * quarter))
            low = pose([*place, spot.top + half], turned)
            above = ik.reachable(low.raised(lift), cell.home, restarts=restarts)
            if any(ik.nearby(low, q) is not None for q in above):
                return True
        return False

    return all(is_reached(place) for place in spot.places)


def _furnish(
    spec: mujoco.MjSpec, scene: SceneConfig, spot: TableSpot, half: Array, reach: float
) -> list[mujoco.MjsBody]:
    """Add table and blocks to a model; return their bodies."""
    turned = [np.cos(0.5 * spot.front), 0.0, 0.0, np.sin(0.5 * spot.front)]
    (name,) = scene.supports
    table = spec.worldbody.add_body(name=name, pos=[*spot.middle, spot.top - 0.02], quat=turned)
    box = mujoco.mjtGeom.mjGEOM_BOX
    sizes = [0.15 * reach, 0.4 * reach, 0.02]
    table.add_geom(name=name, type=box, size=sizes, rgba=[0.6, 0.5, 0.4, 1.0])
    added = [table]
    colours = ([0.2, 0.4, 0.8, 1.0], [0.2, 0.7, 0.3, 1.0])
    for name, place, colour in zip(scene.objects, spot.places, colours, strict=False):
        at = [*place, spot.top + half[2]]
        block = spec.worldbody.add_body(name=name, pos=at, quat=turned)
        block.add_freejoint(name=name)
        geom = block.add_geom(name=name, type=box, size=half, rgba=colour)
        geom.mass = DENSITY * float(np.prod(2.0 * half))
        geom.group = spec.compiler.inertiagrouprange[0]  # of others no inertia is inferred
        geom.condim = 4
        geom.friction[:] = [1.0, 0.02, 0.001]
        # As stiff with any finger: the mean with MuJoCo's 20 ms lets what is carried drift.
        geom.priority = 1
        geom.solref[:] = [0.002, 1.0]
        geom.solimp[:3] = [0.95, 0.99, 0.001]
        added.append(block)
    bits = 1
    for geom in spec.geoms:
        bits |= geom.contype | geom.conaffinity
    # The model's own defaults may say otherwise; blocks touch pads that touch nothing else, too.
    for body, own in zip(added, (1, bits, bits), strict=True):
        body.geoms[0].contype = body.geoms[0].conaffinity = own
    return added


class _Hurried(MotionPlanner):
    """Finds no more paths after `REHEARSAL_S`."""

    def __init__(self, cell: Cell, scene: SceneConfig, seed: int) -> None:
        super().__init__(cell, scene, seed)
        self._end = time.process_time() + REHEARSAL_S

    def plan(self, *args: Any, **wishes: Any) -> Path:
        """Plan as the task level does. Raises `Refused`, too, when it is late."""
        if time.process_time() > self._end:
            raise Refused(Error.NO_PATH, f"no way found in {REHEARSAL_S:g} s of processor time")
        return super().plan(*args, **wishes)


def _rehearse(made: Draft, scene: SceneConfig, actions: list[Document]) -> Rehearsal:
    """Plan a whole program. Raises `Refused`, or `RobotError` for a start in contact."""
    cell = made.cell(scene)
    check_start(cell, made.robot, "home", cell.home)
    data = cell.start()
    situation = Situation(data.xpos[cell.bodies].copy(), data.xquat[cell.bodies].copy())
    start = Rehearsal(_Hurried(cell, scene, SEED), cell.home, situation)
    return rehearse(TaskConfig.model_validate({"action": actions}), scene, start)


def _tour(made: Draft) -> Assignment:
    cell = made.cell()
    check_start(cell, made.robot, "home", cell.home)
    planner = MotionPlanner(cell, NOTHING, SEED)
    statics = Statics(cell)
    actions: list[Document] = []
    for q in poses(cell):
        wanted = {"do": "goto", "joints": q.round(3).tolist()}
        try:
            if planner.checker.free(q) and statics.held(q)[0].min() > LEAST_PART:
                _rehearse(made, NOTHING, [*actions, wanted])
                actions.append(wanted)
        except Refused:
            continue
        if len(actions) == STOPS:
            break
    if not actions:
        raise RobotError("no pose can be reached from home without contact")
    return Assignment(NOTHING, [*actions, {"do": "home"}], "a tour of poses")
