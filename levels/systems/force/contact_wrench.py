"""The wrench of a contact, from samples of the wrist sensor.

A sample is of a contact, of the weight, and of the inertia of all that hangs on the flange. The
last two follow from the model: it evaluates the same sensor at the same motion, without any
contact. So no mass is entered twice, and a tool with joints of its own needs no special case.
"""

from __future__ import annotations

import mujoco
import numpy as np

from rack.levels.algebra import Array
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.robot.wrist import Wrist
from rack.levels.systems.force.hybrid_law import turned
from rack.levels.systems.force.messages import AXES

BY_AXIS = [0, 3, 1, 4, 2, 5]
"""Components of a wrench in the order in which their torques are added up."""


class ContactWrench:
    """The wrench of a contact, from samples of the wrist sensor and the motion of the arm."""

    def __init__(self, cell: Cell, wrist: Wrist, dynamics: Dynamics) -> None:
        """Use `dynamics` of the cell, the arm's: an evaluation at the same state costs nothing."""
        self._cell = cell
        self._site = wrist.site
        self._dynamics = dynamics
        self._range = np.repeat(wrist.range, 3)
        self._jacobian = np.zeros((AXES, cell.model.nv))
        # (6,), N, N m: as sensed, in the sensor's frame.
        self.raw = np.zeros(AXES)
        # (6,), N, N m: of the contact on the tool, at the tool, in the world's frame.
        self.wrench = np.zeros(AXES)
        self.torque = np.zeros(len(cell.dof))  # (joints,), N m: of the contact on the joints
        # The sample is at the end of the range, or NaN: the contact may be any stronger.
        self.saturated = True

    def take(self, raw: Array, state: Array, acceleration: Array) -> None:
        """Take a sample (6,), N, N m, at the state (2, joints), rad, rad/s, and the accelerations
        (joints,), rad/s2."""
        self.raw[:] = raw
        self.saturated = not bool((np.abs(raw) < self._range).all())  # written so that NaN counts
        if not np.isfinite(raw).all():
            return
        self._dynamics.terms(*state)
        model, data = self._dynamics.evaluated
        data.qacc[self._cell.dof] = acceleration
        mujoco.mj_rnePostConstraint(model, data)
        body = model.site_bodyid[self._site]
        place = data.site_xpos[self._site]
        # MuJoCo keeps torque before force, about the centre of the tree that the body belongs to.
        inner = data.cfrc_int[body]
        expected = np.concatenate((inner[3:], inner[:3]))
        moment = np.zeros(3)
        mujoco.mju_cross(moment, place - data.subtree_com[model.body_rootid[body]], expected[:3])
        expected[3:] -= moment
        self.wrench[:] = expected - turned(data.site_xmat[self._site].reshape(3, 3), raw)
        mujoco.mju_cross(moment, place - data.site_xpos[self._cell.tool], self.wrench[:3])
        self.wrench[3:] += moment
        jacobian = self._jacobian
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], self._cell.tool)
        torques = jacobian[:, self._cell.dof] * self.wrench[:, None]
        self.torque[:] = torques[BY_AXIS].sum(axis=0)
