"""Data derived from the arm and its cell.

Importing MuJoCo takes 0.5 s, so the import is inside functions: only racks with an arm pay for it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rack.boards.config.schema import RackConfig
from rack.boards.errors import Mistake
from rack.levels.errors import RobotError
from rack.levels.tables import RobotConfig, SceneConfig

if TYPE_CHECKING:
    from rack.levels.robot.cell import Cell


def cell_sizes(config: RackConfig, mistakes: list[Mistake], is_whole: bool = True) -> dict[str, int]:
    """Return the symbolic sizes by name, none without an arm; add every mistake in the cell to `mistakes`.

    If [robot] or [scene] has mistakes of its own, the cell is not whole and only names are checked.
    """
    if config.robot is None:
        return {}
    found: list[str] = []
    try:
        if is_whole:
            from rack.levels.robot.cell import sizes

            return sizes(built_cell(config.robot, config.scene, config.clock_ns))
    except RobotError as error:
        found = [str(error)]
    for line in _unknown_names(config.robot, config.scene) or found:
        place, colon, why = line.partition(": ")
        is_key = colon and place.startswith(("robot", "scene"))
        mistakes.append(Mistake(place, None, why) if is_key else Mistake("robot", None, line))
    return {}


def _unknown_names(robot: RobotConfig, scene: SceneConfig) -> tuple[str, ...]:
    """Return a line for every name missing from the model; none if the model cannot be read."""
    from rack.levels.robot.lookup import unknown_names

    try:
        return tuple(unknown_names(robot, scene))
    except RobotError:
        return ()


def geom_name(robot: RobotConfig, scene: SceneConfig, clock_ns: int, geom: int) -> str:
    """Return the name of a geom of the cell."""
    from rack.levels.robot import lookup

    return lookup.geom_name(built_cell(robot, scene, clock_ns).model, geom)


def joint_ranges(robot: RobotConfig, scene: SceneConfig, clock_ns: int) -> NDArray[np.float64]:
    """Return the range of commanded joint positions, (joints, 2), rad. Raises `RobotError`."""
    return built_cell(robot, scene, clock_ns).limits.position


def built_cell(robot: RobotConfig, scene: SceneConfig, clock_ns: int) -> Cell:
    """Return the cell. Raises `RobotError`."""
    from rack.levels.robot.cell import build_cell

    return build_cell(robot, scene, clock_ns)
