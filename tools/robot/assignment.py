"""Finds a task for a drafted arm: a table with two blocks to move, or a tour of poses.

Either is planned in advance, exactly as the task level will plan it.
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
from rack.levels.planning.pose import build_pointing_quaternion, make_pose
from rack.levels.robot.abilities import Statics
from rack.levels.robot.cell import Cell, check_start
from rack.levels.tables import SceneConfig
from rack.levels.task.actions import LEANING_RESTARTS, rehearse
from rack.levels.task.grasps import FULL_ORIENTATION, QUARTER_TURNS
from rack.levels.task.program import DOWN, TaskConfig
from rack.levels.task.rehearsal import Rehearsal
from rack.tools.console.answer import Document
from rack.tools.robot.draft import (
    EMPTY_SCENE,
    MIN_SPARE_TORQUE,
    Draft,
    FittedGripper,
    find_home,
    sample_poses,
)

SEED = 1990
"""Seed of `nasrem`."""
TABLE_HEIGHTS = (0.05, 0.2, -0.1, 0.4, 0.6)
TABLE_DISTANCES = (0.55, 0.7, 0.42, 0.34)
TABLE_DIRECTIONS = (0.0, 0.5 * np.pi, -0.5 * np.pi, np.pi)
"""Tables that are tried: height over the base, distance of the centre, and direction in rad.

Heights and distances are fractions of the reach."""
BLOCK_PLACES = ((-0.04, -0.1), (0.04, -0.26), (-0.04, 0.1), (0.04, 0.26))
"""Starts and ends of the blocks: outward and sideways from the centre, as fractions of the reach.
"""
MAX_TABLES = 4
"""Maximum number of tables on which the whole task is rehearsed."""
SEARCH_S = 15.0
"""Approximate processor time after which the search for a table ends and a tour is planned."""
REHEARSAL_S = 10.0
"""Longest processor time for planning the task on one table.

Successful rehearsals took at most 1.6 s. Without a path between the blocks, each attempt to find
one takes 2 s.
"""
TOUR_POSES = 4
"""Number of poses in a tour."""
BLOCK_NAMES = ("block1", "block2")
TABLE_NAME = "table"
"""Names of table and blocks. Others are used if the model has these already."""
MAX_BLOCK_M = 0.05
DENSITY = 400.0  # kg/m3
TABLE_CLEARANCE_M = 0.008
"""Clearance between fingers and table when a block is taken."""
EXTRA_CLEARANCE_M = 0.004
"""Additional clearance if the motion of following fingers is a guess.

With less, Robotiq's 140 touches the table.
"""


class TableSpot(NamedTuple):
    """Position of a table, with start and goal positions for two blocks."""

    top: float  # m
    direction: float  # rad
    places: list[Array]  # four, (2,), m
    centre: Array  # (2,), m


@dataclass(frozen=True)
class Assignment:
    """A scene and a program for it.

    Attributes:
        scene: Objects and supports.
        actions: The program, as tables of a config.
        kind: Description of the program for the user.
    """

    scene: SceneConfig
    actions: list[Document]
    kind: str


def find_assignment(draft: Draft) -> Assignment:
    """Find a task for an arm: blocks to move if possible, otherwise a tour of poses.

    The draft's home is changed to suit the task. Table and blocks are added to its model. Raises
    `RobotError` if not even a tour is possible.
    """
    if draft.gripper is not None:
        result = _find_transfers(draft, draft.gripper)
        if isinstance(result, Assignment):
            return result
        draft.notes.append(f"no transfer, but a tour of poses: {result}")
    return _find_tour(draft)


def _find_transfers(draft: Draft, gripper: FittedGripper) -> Assignment | str:
    """Find a table on which the arm can move two blocks. If there is none, return the reason."""
    cell = draft.build_cell()
    fingertips = gripper.fingertips
    width = min(fingertips.block_width, MAX_BLOCK_M)
    # The tool goes to the centre of a standing block, so the block keeps the fingers off the table.
    clear = TABLE_CLEARANCE_M + EXTRA_CLEARANCE_M * bool(gripper.config.follow)
    half = 0.5 * np.array([width, width, max(width, 2.0 * (fingertips.length_below + clear))])
    reach = _estimate_reach(cell)
    lift = round(min(0.1, 0.12 * reach), 3)
    reason = "no table on which the tool comes down to blocks"
    spots = (
        spot
        for spot in _list_table_spots(cell, reach)
        if _can_reach_blocks(cell, spot, half[2], lift)
    )
    used_names = {body.name for body in draft.spec.bodies} | {
        geom.name for geom in draft.spec.geoms
    }
    table, *blocks = (
        f"{name} of rack" if name in used_names else name for name in (TABLE_NAME, *BLOCK_NAMES)
    )
    scene = SceneConfig(objects=tuple(blocks), supports=(table,))
    for spot in itertools.islice(spots, MAX_TABLES):
        added = _add_furniture(draft.spec, scene, spot, half, reach)
        draft.write_model()
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
            draft.home = find_home(
                draft, scene, [np.array(action["to"]) for action in actions[:-1]]
            )
            _rehearse_program(draft, scene, actions)
            return Assignment(scene, actions, "a table, two blocks to move")
        except (Refused, RobotError) as refused:
            reason = str(refused)
        for body in added:
            draft.spec.delete(body)
        draft.write_model()
    draft.home = find_home(draft)
    return reason


def _estimate_reach(cell: Cell) -> float:
    """Estimate the largest distance of the tool from the base in m."""
    ik = InverseKinematics(cell, SEED)
    base = _locate_base(cell)
    return max(norm(ik.compute_tool_pose(q).position - base) for q in sample_poses(cell))


def _locate_base(cell: Cell) -> Array:
    """Return the position of the arm's base, (3,), in m.

    It is below the first joint, at the height of the body at the root of the arm.
    """
    data = cell.build_start_data()
    joint = cell.model.dof_jntid[cell.dof[0]]
    root = cell.model.body_rootid[cell.model.jnt_bodyid[joint]]
    return np.array([*data.xanchor[joint][:2], data.xpos[root][2]])


def _list_table_spots(cell: Cell, reach: float) -> Iterator[TableSpot]:
    """Yield candidate positions of table and blocks until `SEARCH_S` of processor time is used."""
    base = _locate_base(cell)
    end = time.process_time() + SEARCH_S
    for height, distance, front in itertools.product(
        TABLE_HEIGHTS, TABLE_DISTANCES, TABLE_DIRECTIONS
    ):
        if time.process_time() > end:
            return
        out = np.array([np.cos(front), np.sin(front)])
        side = np.array([-out[1], out[0]])
        middle = base[:2] + distance * reach * out
        places = [middle + reach * (a * out + b * side) for a, b in BLOCK_PLACES]
        yield TableSpot(round(base[2] + height * reach, 3), front, places, middle)


def _can_reach_blocks(cell: Cell, spot: TableSpot, half_height: float, lift: float) -> bool:
    """Return True if the tool can be lowered to every block position.

    Args:
        cell: The arm.
        spot: The table and the positions of its blocks.
        half_height: Half the height of a block in m.
        lift: Height in m above each position from which the tool is lowered.
    """
    ik = InverseKinematics(cell, SEED)
    # An arm with fewer joints has fewer solutions, so search longer for one.
    restarts = MAX_RESTARTS if len(cell.qpos) >= FULL_ORIENTATION else LEANING_RESTARTS

    def is_reached(place: Array) -> bool:
        """Return True if the tool can be lowered to a position with any finger direction."""
        for quarter in QUARTER_TURNS:
            orientation = build_pointing_quaternion(DOWN, -(spot.direction + 0.5 * np.pi * quarter))
            placed = make_pose([*place, spot.top + half_height], orientation)
            raised = ik.find_solutions(placed.raise_by(lift), cell.home, restarts=restarts)
            if any(ik.find_nearby(placed, q) is not None for q in raised):
                return True
        return False

    return all(is_reached(place) for place in spot.places)


def _add_furniture(
    spec: mujoco.MjSpec, scene: SceneConfig, spot: TableSpot, half: Array, reach: float
) -> list[mujoco.MjsBody]:
    """Add table and blocks to a model.

    Args:
        spec: The model, which is changed.
        scene: Names of table and blocks.
        spot: Positions of table and blocks.
        half: Half the size of a block, (3,), in m.
        reach: Reach of the arm in m, which determines the size of the table.

    Returns:
        The added bodies.
    """
    quaternion = [np.cos(0.5 * spot.direction), 0.0, 0.0, np.sin(0.5 * spot.direction)]
    (name,) = scene.supports
    table = spec.worldbody.add_body(name=name, pos=[*spot.centre, spot.top - 0.02], quat=quaternion)
    box = mujoco.mjtGeom.mjGEOM_BOX
    sizes = [0.15 * reach, 0.4 * reach, 0.02]
    table.add_geom(name=name, type=box, size=sizes, rgba=[0.6, 0.5, 0.4, 1.0])
    added = [table]
    colours = ([0.2, 0.4, 0.8, 1.0], [0.2, 0.7, 0.3, 1.0])
    for name, place, colour in zip(scene.objects, spot.places, colours, strict=False):
        position = [*place, spot.top + half[2]]
        block = spec.worldbody.add_body(name=name, pos=position, quat=quaternion)
        block.add_freejoint(name=name)
        geom = block.add_geom(name=name, type=box, size=half, rgba=colour)
        geom.mass = DENSITY * float(np.prod(2.0 * half))
        # MuJoCo infers inertia only from geoms in certain groups.
        geom.group = spec.compiler.inertiagrouprange[0]
        geom.condim = 4
        geom.friction[:] = [1.0, 0.02, 0.001]
        # Give this stiffness priority in every contact. If it were averaged with MuJoCo's default
        # of 20 ms, a carried block would drift.
        geom.priority = 1
        geom.solref[:] = [0.002, 1.0]
        geom.solimp[:3] = [0.95, 0.99, 0.001]
        added.append(block)
    bits = 1
    for geom in spec.geoms:
        bits |= geom.contype | geom.conaffinity
    # Override the model's defaults, so that blocks also collide with pads that touch nothing else.
    for body, contact_bits in zip(added, (1, bits, bits), strict=True):
        body.geoms[0].contype = body.geoms[0].conaffinity = contact_bits
    return added


class _TimedMotionPlanner(MotionPlanner):
    """Motion planner that may use at most `REHEARSAL_S` of processor time."""

    def __init__(self, cell: Cell, scene: SceneConfig, seed: int) -> None:
        super().__init__(cell, scene, seed)
        self._end = time.process_time() + REHEARSAL_S

    def plan(self, *args: Any, **options: Any) -> Path:
        """Plan as `MotionPlanner` does. Also raises `Refused` once the time is used up."""
        if time.process_time() > self._end:
            raise Refused(Error.NO_PATH, f"no way found in {REHEARSAL_S:g} s of processor time")
        return super().plan(*args, **options)


def _rehearse_program(draft: Draft, scene: SceneConfig, actions: list[Document]) -> Rehearsal:
    """Plan a whole program.

    Raises:
        Refused: A motion cannot be planned.
        RobotError: The cell is invalid, or the arm is in contact at the start.
    """
    cell = draft.build_cell(scene)
    check_start(cell, draft.robot, "home", cell.home)
    data = cell.build_start_data()
    situation = Situation(data.xpos[cell.bodies].copy(), data.xquat[cell.bodies].copy())
    start = Rehearsal(_TimedMotionPlanner(cell, scene, SEED), cell.home, situation)
    return rehearse(TaskConfig.model_validate({"action": actions}), scene, start)


def _find_tour(draft: Draft) -> Assignment:
    """Find poses that can be reached one after the other. Raises `RobotError` if there are none."""
    cell = draft.build_cell()
    check_start(cell, draft.robot, "home", cell.home)
    planner = MotionPlanner(cell, EMPTY_SCENE, SEED)
    statics = Statics(cell)
    actions: list[Document] = []
    for q in sample_poses(cell):
        action = {"do": "goto", "joints": q.round(3).tolist()}
        try:
            if (
                planner.checker.is_free(q)
                and statics.compute_load_limits(q)[0].min() > MIN_SPARE_TORQUE
            ):
                _rehearse_program(draft, EMPTY_SCENE, [*actions, action])
                actions.append(action)
        except Refused:
            continue
        if len(actions) == TOUR_POSES:
            break
    if not actions:
        raise RobotError("no pose can be reached from home without contact")
    return Assignment(EMPTY_SCENE, [*actions, {"do": "home"}], "a tour of poses")
