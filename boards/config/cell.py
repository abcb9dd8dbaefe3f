"""Data derived from the arm and its cell.

MuJoCo is imported inside the functions, because the import takes 0.5 s and racks without an arm do
not need it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rack.backplane.checked import select_item
from rack.boards.config.schema import RackConfig

if TYPE_CHECKING:
    from rack.levels.robot.cell import Cell


def compute_cell_sizes(config: RackConfig) -> dict[str, int]:
    """Return the sizes to which message types refer by name, such as the number of joints.

    The result is empty for a rack without an arm. Raises `RobotError` if the arm or the scene does
    not match the MuJoCo model.
    """
    if config.robot is None:
        return {}
    from rack.levels.robot.cell import compute_sizes

    return compute_sizes(build_rack_cell(config))


def find_geom_name(config: RackConfig, geom: int) -> str:
    """Return the name of the geom with the given number in the cell of the rack.

    The number comes from shared memory. Raises `DamageError` if there is no such geom.
    """
    from rack.levels.robot import lookup

    model = build_rack_cell(config).model
    return lookup.find_geom_name(model, select_item(range(model.ngeom), geom, "geom"))


def build_rack_cell(config: RackConfig) -> Cell:
    """Build the cell of a rack that has an arm.

    Raises `RobotError` if the arm or the scene does not match the MuJoCo model.
    """
    from rack.levels.robot.cell import build_cell

    assert config.robot is not None, "the rack has an arm"
    return build_cell(config.robot, config.scene, config.clock_ns)
