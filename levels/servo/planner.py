"""The planner of the servo level: the arm's inertia for the coming cycles."""

from __future__ import annotations

import mujoco
import numpy as np

from rack.levels.algebra import mat_vec, transposed_mat_vec
from rack.levels.level import Input, LevelContext, Output, Planner
from rack.levels.messages import JointCommand, Scene, ServoPlan, ServoStatus
from rack.levels.robot.cell import build_level_cell
from rack.levels.robot.dynamics import Dynamics, Payload


class ServoPlanner(Planner):
    """Computes the inertia, including a held object, at the next set point in every release."""

    above = Input(JointCommand, "above.command")
    status = Input(ServoStatus, "own.status")
    scene = Input(Scene, "own.scene")
    output = Output(ServoPlan)

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self._cell = build_level_cell(context)
        self._dynamics = Dynamics(self._cell)

    def wanted(self, tick: int) -> bool:
        """Return True, because the inertia changes whenever the arm moves."""
        return True

    def plan(self, tick: int) -> None:
        """Compute the inertia and the payload, and write them to the `ServoPlan`."""
        command = self.above.message
        held = -1
        payload = Payload(0.0, np.zeros(3))
        objects = len(self._cell.object_qpos)
        if command.due != 0 and self.scene.has_message and 0 <= command.held < objects:
            held = command.held
            payload = self._compute_payload(self.scene.message, held)
        # Use the next set point, else the sensed position, or home before the first status.
        position = self._cell.home
        if command.due != 0 and np.isfinite(command.position).all():
            position = command.position
        elif self.status.has_message:
            position = self.status.message.position
        terms = self._dynamics.terms(position, np.zeros_like(position), payload)
        self.output.inertia = terms.inertia
        self.output.held = held
        self.output.payload_mass = payload.mass
        self.output.payload_offset = payload.offset

    def _compute_payload(self, scene: Scene, held: int) -> Payload:
        """Return the payload that an object puts on the tool, from its pose in the scene.

        Args:
            scene: Poses of the objects and the tool.
            held: Row of the object in the gripper.

        Returns:
            Mass, kg, and its centre in the frame of the tool, m.
        """
        model = self._cell.model
        body = self._cell.bodies[held]
        turned = np.zeros(9)
        rotation = turned.reshape(3, 3)
        mujoco.mju_quat2Mat(turned, scene.quaternion[held])
        centre = scene.position[held] + mat_vec(rotation, model.body_ipos[body])
        mujoco.mju_quat2Mat(turned, scene.tool_quaternion)
        offset = transposed_mat_vec(rotation, centre - scene.tool_position)
        return Payload(float(model.body_subtreemass[body]), offset)
