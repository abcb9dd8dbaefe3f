"""Random layouts of two blocks for the PUMA: how many are done, and is every refusal right?

    python -m tests.levels.task.layouts --count 50 --seed 1990

Each layout places both blocks at random on the table, turned at random, and asks for two transfers
to random places. A layout that the rack refuses is judged by a search of its own: other inverse
kinematics, other random starts, and MuJoCo's contacts alone. It takes some seconds a layout.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np

from rack.backplane.message import State
from rack.levels.messages import Error
from rack.levels.robot.cell import Cell, build_cell
from rack.levels.tables import RobotConfig, SceneConfig
from tests.levels.arms import CLOCK_NS, ROBOTS, config
from tests.levels.whole_rack import WholeRack

TABLE = ((0.35, 0.80), (-0.45, 0.45))  # m: where block origins may be
ORIGIN_Z = 0.475
APART_M = 0.085  # between centres: fingers fit in between
WALL = (0.5, 0.0, 0.02, 0.12)  # centre and half sizes
PEG = (0.5, -0.3)
LIFT_M = 0.1
MOST_S = 60.0
TOLERANCE_M = 0.01
CLEARANCE_M = 0.016  # from the wall: what the PUMA's config demands, and 1 mm for opened fingers
AWAY_M = 5.0
STARTS = 40  # of the search that judges a refusal
QUARTERS = np.arange(4) * np.pi / 2
TURNS = np.arange(16) * np.pi / 8


class Grasp(NamedTuple):
    """How a block is held: the tool's lean from straight down, rad, and its height over the block's
    centre, m."""

    tilt: float
    height: float


TILTS = np.radians((0, 15, 25, 35, 45, 55, 65, 75, 85))
GRASPS = [Grasp(tilt, height) for tilt in TILTS for height in (0.0, 0.02)]


class Layout(NamedTuple):
    """Where two blocks begin, and where they go, m; their turns, rad."""

    begin: np.ndarray
    end: np.ndarray
    yaw: np.ndarray


def draw(rng: np.random.Generator) -> Layout:
    """Return a layout in which every place is clear of the others, the wall and the peg."""
    while True:
        places = rng.uniform([span[0] for span in TABLE], [span[1] for span in TABLE], (4, 2))
        gaps = [math.dist(a, b) for k, a in enumerate(places) for b in places[:k]]
        gaps += [math.dist(place, PEG) for place in places]
        off = np.maximum(np.abs(places - WALL[:2]) - WALL[2:], 0.0)
        if min(gaps) > APART_M and np.min(np.linalg.norm(off, axis=1)) > APART_M / 2:
            return Layout(places[:2], places[2:], rng.uniform(-np.pi, np.pi, 2))


def arm(folder: Path, layout: Layout) -> tuple[RobotConfig, SceneConfig]:
    """Write the PUMA's cell with a layout to `folder`; return robot and scene."""
    folder.mkdir()
    text = (ROBOTS / "puma560_cell.xml").read_text()
    for name, old, place, yaw in zip(
        ("block1", "block2"),
        (".50 .30 .475", ".60 .30 .475"),
        layout.begin,
        layout.yaw,
        strict=True,
    ):
        turn = f'quat="{math.cos(yaw / 2)} 0 0 {math.sin(yaw / 2)}"'
        new = f'name="{name}" pos="{place[0]} {place[1]} {ORIGIN_Z}" {turn}'
        text = text.replace(f'name="{name}" pos="{old}"', new)
    (folder / "puma560.xml").write_text((ROBOTS / "puma560.xml").read_text())
    (folder / "cell.xml").write_text(text)
    robot, scene = config("puma560")
    return robot.model_copy(update={"model": folder / "cell.xml"}), scene


class Search:
    """Searches for a way to stand over a place and come down to it, independently of planning."""

    def __init__(self, cell: Cell, seed: int) -> None:
        self._cell = cell
        self._data = cell.start()
        self._rng = np.random.default_rng(seed)
        self._low, self._high = cell.limits.position.T
        self._wall = cell.model.geom("wall").id

    def reaches(self, place: np.ndarray, headings: np.ndarray, grasp: Grasp) -> bool:
        """Return whether some configuration is free at a place, and another above it."""
        over = np.array([*place, ORIGIN_Z + grasp.height])
        above = np.array([*place, ORIGIN_Z + grasp.height + LIFT_M])
        return any(
            self._free(over, heading, grasp.tilt) and self._free(above, heading, grasp.tilt)
            for heading in headings
        )

    def moves(self, block: int) -> None:
        """Take a block out of the way: it is in the gripper, or has been moved."""
        self._data.qpos[self._cell.object_qpos[block] + 2] = AWAY_M

    def _free(self, point: np.ndarray, heading: float, tilt: float) -> bool:
        reached = (self._reached(point, heading, tilt) for _ in range(STARTS))
        return any(q is not None and not self._touches(q) for q in reached)

    def _reached(self, point: np.ndarray, heading: float, tilt: float) -> np.ndarray | None:
        """Return a configuration with the tool at a point, leaning by `tilt` over `heading`, by
        damped least squares from a random start."""
        cell, data = self._cell, self._data
        q = self._rng.uniform(self._low, self._high)
        ahead = np.array([math.cos(heading), math.sin(heading), 0.0])
        across = np.array([-math.sin(heading), math.cos(heading), 0.0])
        along = math.sin(tilt) * ahead - np.array([0.0, 0.0, math.cos(tilt)])
        wanted = np.column_stack((np.cross(across, along), across, along))
        jacobian = np.zeros((6, cell.model.nv))
        for _ in range(40):
            data.qpos[cell.qpos] = q
            mujoco.mj_kinematics(cell.model, data)
            mujoco.mj_comPos(cell.model, data)
            turned = data.site_xmat[cell.tool].reshape(3, 3)
            turn = sum(np.cross(turned[:, k], wanted[:, k]) for k in range(3))
            error = np.concatenate((point - data.site_xpos[cell.tool], 0.5 * np.asarray(turn)))
            if np.max(np.abs(error)) < 1e-4 and np.trace(turned.T @ wanted) > 2.9:
                return q
            mujoco.mj_jacSite(cell.model, data, jacobian[:3], jacobian[3:], cell.tool)
            rows = jacobian[:, cell.dof]
            step = rows.T @ np.linalg.solve(rows @ rows.T + 1e-4 * np.eye(6), error)
            q = np.clip(q + np.clip(step, -0.3, 0.3), self._low, self._high)
        return None

    def _touches(self, q: np.ndarray) -> bool:
        """Return whether the arm at `q` is in a contact that it must not be in, or too near the
        wall."""
        cell, data = self._cell, self._data
        data.qpos[cell.qpos] = q
        mujoco.mj_fwdPosition(cell.model, data)
        contact = data.contact
        touches = cell.touch[contact.geom[:, 0], contact.geom[:, 1]] & (contact.dist < 0)
        return bool(np.any(touches)) or any(
            mujoco.mj_geomDistance(cell.model, data, int(link), self._wall, CLEARANCE_M, None)
            < CLEARANCE_M
            for link in cell.arm_geoms
        )


def is_possible(cell: Cell, layout: Layout, block: int, seed: int) -> bool:
    """Return whether some grasp of the independent search takes a block and puts it down; the
    blocks before it are out of the way."""
    search = Search(cell, seed)
    for moved in range(block):
        search.moves(moved)
    sides = layout.yaw[block] + QUARTERS
    picks = [grasp for grasp in GRASPS if search.reaches(layout.begin[block], sides, grasp)]
    search.moves(block)
    return any(search.reaches(layout.end[block], TURNS, grasp) for grasp in picks)


def refused_action(reason: str) -> int:
    """Return the number of the action that a reason begins with."""
    return int(reason.removeprefix("action ").partition(",")[0])


def outcome(folder: Path, layout: Layout, seed: int) -> tuple[str, str]:
    """Return "done", "refused rightly", "refused wrongly" or "failed", and why."""
    robot, scene = arm(folder, layout)
    actions = [
        {"do": "transfer", "object": f"block{k + 1}", "to": [*map(float, layout.end[k]), ORIGIN_Z]}
        for k in range(2)
    ]
    rack = WholeRack(arm=(robot, scene), actions=actions)
    status = rack.run_to_end(MOST_S)
    if status.state == State.DONE:
        blocks = rack.read("world.model").position[:2, :2]
        away = float(np.max(np.linalg.norm(blocks - layout.end, axis=1)))
        return ("done", "") if away < TOLERANCE_M else ("failed", f"{away * 1e3:.1f} mm off")
    reason = str(status.reason)
    if status.error in (Error.UNREACHABLE, Error.NO_PATH) and not rack.move.done:
        cell = build_cell(robot, scene, CLOCK_NS)
        is_wrong = is_possible(cell, layout, refused_action(reason), seed)
        return "refused wrongly" if is_wrong else "refused rightly", reason
    return "failed", reason or "time over"


def main() -> None:
    """Print every layout's outcome and their counts."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--count", type=int, default=50)
    options.add_argument("--seed", type=int, default=1990)
    options.add_argument("--first", type=int, default=0, help="layout to begin with")
    given = options.parse_args()
    counts: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for k in range(given.first, given.count):
            layout = draw(np.random.default_rng([given.seed, k]))
            result, reason = outcome(Path(folder) / str(k), layout, k)
            counts[result] += 1
            sys.stdout.write(f"{k:3} {result:16} {reason}\n")
            sys.stdout.flush()
    counted = ", ".join(f"{result}: {count}" for result, count in sorted(counts.items()))
    sys.stdout.write(f"{counted}\n")


if __name__ == "__main__":
    main()
