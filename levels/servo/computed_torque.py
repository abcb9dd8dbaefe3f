"""The joint loop: torques that make every joint's error that of a damped oscillator, whatever the arm's state."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rack.backplane.message import Message
from rack.levels.algebra import mat_vec
from rack.levels.cell import Cell
from rack.levels.dynamics import Dynamics, Payload, Terms
from rack.levels.servo.curves import Motion
from rack.levels.servo.params import ServoParams

Array = NDArray[np.float64]


class ComputedTorque:
    """torque = M (qdd + 2 d w (qd_wanted - qd) + w^2 (q_wanted - q)) + bias(q, qd) + dry friction; M is the planner's.

    Within the torque limits: what is beyond them at the limit gate is no torque of this level.
    """

    def __init__(self, cell: Cell, params: ServoParams) -> None:
        self._dynamics = Dynamics(cell)
        self._limits = cell.bounds.torque
        self._stiffness = params.bandwidth**2
        self._damping = 2.0 * params.damping * params.bandwidth
        self.cut = 0
        """Cycles in which a torque limit cut the torque wanted."""

    def terms(self, position: Array, velocity: Array, plan: Message | None) -> Terms:
        """Return the equation of motion at rad, rad/s, with what the gripper holds. Valid until the next call."""
        payload = None if plan is None else Payload(plan.payload_mass, plan.payload_offset)
        return self._dynamics.terms(position, velocity, payload)

    def torque(self, wanted: Motion, position: Array, velocity: Array, terms: Terms, plan: Message | None) -> Array:
        """Return the torques, (joints,), N m, that lead to the motion wanted."""
        inertia = terms.inertia if plan is None else plan.inertia
        acceleration = (
            wanted.acceleration
            + self._damping * (wanted.velocity - velocity)
            + self._stiffness * (wanted.position - position)
        )
        torque = mat_vec(inertia, acceleration) + terms.bias + self._dynamics.friction(wanted.velocity)
        possible = np.minimum(np.maximum(torque, -self._limits), self._limits)
        self.cut += bool(np.count_nonzero(possible != torque))
        return np.asarray(possible)
