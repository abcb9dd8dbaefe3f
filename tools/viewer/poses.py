"""The cell in motion: poses of all moving bodies from the arm's recorded state, and the way of its tool."""

from __future__ import annotations

import mujoco
import numpy as np
import rerun as rr

from rack.levels.robot.cell import STATE, Cell
from rack.tools.viewer.blocks import Block
from rack.tools.viewer.geometry import CELL, WORLD, frame_of, moving_bodies
from rack.tools.viewer.shapes import xyzw
from rack.tools.viewer.stream import Stream

FRAMES = "frames"
POSES_S = 0.02
"""Time from pose to pose: what a screen can show."""
TOOL = (CELL, "tool")
TOOL_COLOUR = (230, 60, 200)


class Poses:
    """Writes `ARM_STATE`s as poses: MuJoCo's own kinematics of the recorded state."""

    def __init__(self, stream: Stream, cell: Cell, clock_ns: int) -> None:
        self._stream, self._cell, self._data = stream, cell, cell.start()
        self._bodies = moving_bodies(cell.model)
        self._frames = [frame_of(cell.model, int(body)) for body in self._bodies]
        self._every = max(1, round(POSES_S * 1e9 / clock_ns))
        self._last = -1
        stream.static(TOOL, rr.Points3D.from_fields(radii=0.003, colors=[TOOL_COLOUR]), rr.CoordinateFrame(WORLD))

    def write(self, block: Block) -> None:
        """Write poses, one every 20 ms of simulated time."""
        if not len(self._bodies):
            return
        slots, first = np.unique(block.ticks // self._every, return_index=True)
        chosen = first[slots > self._last]
        self._last = int(slots[-1])
        if len(chosen):
            self._write(block, chosen)

    def _write(self, block: Block, chosen: np.ndarray) -> None:
        model, data, bodies = self._cell.model, self._data, self._bodies
        positions = np.empty((len(chosen), len(bodies), 3))
        quaternions = np.empty((len(chosen), len(bodies), 4))
        tool = np.empty((len(chosen), 3))
        for row, state in enumerate(block.messages["state"][chosen]):
            mujoco.mj_setState(model, data, np.ascontiguousarray(state), STATE)
            mujoco.mj_kinematics(model, data)
            positions[row], quaternions[row] = data.xpos[bodies], data.xquat[bodies]
            tool[row] = data.site_xpos[self._cell.tool]
        times, count = self._stream.times, len(bodies)
        ticks, stamps = block.ticks[chosen], block.stamps_ns[chosen]
        self._stream.columns(TOOL, times.columns(ticks, stamps), rr.Points3D.columns(positions=tool))
        poses = rr.Transform3D.columns(
            translation=positions.reshape(-1, 3),
            quaternion=xyzw(quaternions).reshape(-1, 4),
            parent_frame=[WORLD] * (len(chosen) * count),
            child_frame=self._frames * len(chosen),
        )
        self._stream.columns((FRAMES,), times.columns(np.repeat(ticks, count), np.repeat(stamps, count)), poses)
