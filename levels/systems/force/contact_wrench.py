"""The wrench of a contact, from samples of the wrist sensor.

A sample is of a contact, of the weight, and of the inertia of all that hangs on the flange. The
last two follow from the model: it evaluates the same sensor at the same motion, without any
contact. So no mass is entered twice, and a tool with joints of its own needs no special case.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from rack.levels.algebra import Array
from rack.levels.compiled import compiled_for
from rack.levels.robot.cell import Cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.robot.engine import mj_jac, mj_rne_post_constraint, one_view
from rack.levels.robot.wrist import Wrist
from rack.levels.systems.force.messages import AXES


class ContactWrench:
    """The wrench of a contact, from samples of the wrist sensor and the motion of the arm."""

    def __init__(self, cell: Cell, wrist: Wrist, dynamics: Dynamics) -> None:
        """Use `dynamics` of the cell, the arm's: an evaluation at the same state costs nothing."""
        self._dynamics = dynamics
        self._range = np.repeat(wrist.range, 3)
        joints = len(cell.dof)
        self.raw = np.zeros(AXES)  # (6,), N, N m: as sensed, in the sensor's frame
        self.wrench = np.zeros(
            AXES
        )  # (6,), N, N m: of the contact on the tool, at the tool, in the world's frame
        self.torque = np.zeros(joints)  # (joints,), N m: of the contact on the joints
        self.saturated = (
            True  # the sample is at the end of the range, or NaN: the contact may be any stronger
        )
        model, data = dynamics.evaluated
        body = int(model.site_bodyid[wrist.site])
        root = int(model.body_rootid[model.site_bodyid[wrist.site]])
        memory, begins = one_view(
            data.qacc, data.cfrc_int, data.site_xpos, data.site_xmat, data.subtree_com
        )
        first = (0, AXES * body, 3 * wrist.site, 9 * wrist.site, 3 * root)
        tool = int(begins[2]) + 3 * cell.tool
        self._places = np.array((*(begins + first), tool, model.site_bodyid[cell.tool]))
        self._fixed = (
            model._address,
            data._address,
            self._places,
            memory,
            cell.dof,
            np.zeros((2, 3, model.nv)),
        )
        self._set = set_contact.load()

    def take(self, raw: Array, state: Array, acceleration: Array) -> None:
        """Take a sample (6,), N, N m, at the state (2, joints), rad, rad/s, and the accelerations
        (joints,), rad/s2."""
        self.raw[:] = raw
        self.saturated = not bool((np.abs(raw) < self._range).all())  # written so that NaN counts
        if not np.isfinite(raw).all():
            return
        self._dynamics.terms(*state)
        self._set(*self._fixed, raw, acceleration, self.wrench, self.torque)


@compiled_for("i8, i8, i8[::1], f8[::1], i8[::1], f8[:,:,::1], f8[::1], f8[::1], f8[::1], f8[::1]")
def set_contact(  # noqa: PLR0913  # flat, as `advance` in levels/arm/substeps.py
    model: int,
    data: int,  # evaluated at the state
    places: NDArray[
        np.int64
    ],  # in `memory`: accelerations, interaction force; sensor's place, frame; reference; tool
    memory: Array,
    dof: NDArray[np.int64],
    jacobians: Array,  # (2, 3, nv)
    raw: Array,
    acceleration: Array,
    wrench: Array,  # set
    torque: Array,  # set
) -> None:
    """Set the wrench of a contact on the tool, and its torque on the joints."""
    qacc, force, site, frame, centre, tool, body = places
    for joint in range(len(dof)):
        memory[qacc + dof[joint]] = acceleration[joint]
    mj_rne_post_constraint(model, data)
    # MuJoCo keeps torque before force, about the centre of the tree that the body belongs to.
    for axis in range(3):
        sensed = turning = 0.0
        for k in range(3):
            sensed += memory[frame + 3 * axis + k] * raw[k]
            turning += memory[frame + 3 * axis + k] * raw[3 + k]
        wrench[axis] = memory[force + 3 + axis] - sensed
        one = (axis + 1) % 3
        other = (axis + 2) % 3
        arm_one = memory[site + one] - memory[centre + one]
        arm_other = memory[site + other] - memory[centre + other]
        expected = memory[force + axis] - (
            arm_one * memory[force + 3 + other] - arm_other * memory[force + 3 + one]
        )
        wrench[3 + axis] = expected - turning
    for axis in range(3):
        one = (axis + 1) % 3
        other = (axis + 2) % 3
        arm_one = memory[site + one] - memory[tool + one]
        arm_other = memory[site + other] - memory[tool + other]
        wrench[3 + axis] += arm_one * wrench[other] - arm_other * wrench[one]
    mj_jac(
        model,
        data,
        jacobians[0].ctypes.data,
        jacobians[1].ctypes.data,
        memory[tool:].ctypes.data,
        body,
    )
    for joint in range(len(dof)):
        torque[joint] = 0.0
        for axis in range(3):
            torque[joint] += jacobians[0, axis, dof[joint]] * wrench[axis]
            torque[joint] += jacobians[1, axis, dof[joint]] * wrench[3 + axis]
