"""Data derived from the arm and its cell.

Importing MuJoCo takes 0.5 s, so the import is inside functions: only racks with an arm pay for it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rack.backplane.checked import pick
from rack.boards.config.schema import RackConfig

if TYPE_CHECKING:
    from rack.levels.robot.cell import Cell


def cell_sizes(config: RackConfig) -> dict[str, int]:
    """Return the symbolic sizes by name, none without an arm. Raises `RobotError`."""
    if config.robot is None:
        return {}
    from rack.levels.robot.cell import sizes

    return sizes(built_cell(config))


def geom_name(config: RackConfig, geom: int) -> str:
    """Return the name of a geom of the cell, by its number in shared memory."""
    from rack.levels.robot import lookup

    model = built_cell(config).model
    return lookup.geom_name(model, pick(range(model.ngeom), geom, "geom"))


def built_cell(config: RackConfig) -> Cell:
    """Return the cell of a rack with an arm. Raises `RobotError`."""
    from rack.levels.robot.cell import build_cell

    assert config.robot is not None, "the rack has an arm"
    return build_cell(config.robot, config.scene, config.clock_ns)
