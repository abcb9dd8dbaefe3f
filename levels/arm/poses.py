"""The poses of bodies and tool, from MuJoCo's memory into a `SCENE`, in compiled code."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import Array
from rack.levels.compiled import compiled_for
from rack.levels.messages import SCENE
from rack.levels.robot.cell import Cell, sizes
from rack.levels.robot.engine import mj_kinematics, mju_mat_to_quat, one_view


class PoseViews(NamedTuple):
    """First arguments of `show`, prepared once."""

    model: int  # address
    data: int  # address
    places: NDArray[np.int64]  # (numbers of a scene,), in `memory`, of each; -1: not set
    memory: Array  # MuJoCo's
    turned: Array  # (9,): the tool's rotation matrix
    quaternion: int  # where the tool's is in a scene


def poses(cell: Cell, data: mujoco.MjData) -> PoseViews:
    """Return the arguments of `show` for `data` of a cell."""
    scene = SCENE.dtype(sizes(cell))
    number = np.dtype(np.float64).itemsize
    begins = {name: field[1] // number for name, field in (scene.fields or {}).items()}
    memory, (position, quaternion, tool) = one_view(data.xpos, data.xquat, data.site_xpos)
    places = np.full(scene.itemsize // number, -1)
    for begin, first, width, rows in (
        (begins["position"], position, 3, cell.bodies),
        (begins["quaternion"], quaternion, 4, cell.bodies),
        (begins["tool_position"], tool, 3, np.array([cell.tool])),
    ):
        where = first + width * rows[:, None] + np.arange(width)
        places[begin : begin + where.size] = where.ravel()
    turned = data.site_xmat[cell.tool]
    return PoseViews(
        cell.model._address, data._address, places, memory, turned, begins["tool_quaternion"]
    )


@compiled_for("i8, i8, i8[::1], f8[::1], f8[::1], i8, f8[::1]")
def show(
    model: int,
    data: int,
    places: NDArray[np.int64],
    memory: Array,
    turned: Array,
    quaternion: int,
    scene: Array,
) -> None:
    """Fill the numbers of a `scene`."""
    mj_kinematics(model, data)  # after a step, poses are those before it
    for number in range(len(places)):
        if places[number] >= 0:
            scene[number] = memory[places[number]]
    mju_mat_to_quat(scene[quaternion:].ctypes.data, turned.ctypes.data)
