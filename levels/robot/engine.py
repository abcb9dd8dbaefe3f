"""MuJoCo's functions and memory, for compiled code.

A call from Python adds 2 us to a MuJoCo step, and half a microsecond to read its contacts; both
happen in every step. Compiled code calls the C library directly, with the addresses of model and
data. If the same code is run as Python, it calls the same functions through ctypes.

If MuJoCo reports a fatal error (its memory is exhausted), the Python bindings raise an exception.
Here the error ends the process, which the exception would have done as well.

The state of a simulation is everything on which its next step depends. MuJoCo's integration state
does not contain which bodies sleep, so that is appended to it. Bodies at rest sleep until something
awake touches them. In `nasrem` the blocks take two thirds of the time of a step while they are
awake. A simulation restored from this state continues bit for bit, asleep or awake.
"""

from __future__ import annotations

import ctypes
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from rack.levels.algebra import Array
from rack.levels.compiled import c_function, compiled

INTEGRATION = int(mujoco.mjtState.mjSTATE_INTEGRATION)
SLEEP = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
LIBRARY = str(Path(mujoco.__file__).with_name(f"libmujoco.so.{mujoco.mj_versionString()}"))


native = partial(c_function, LIBRARY)
"""Declares a C function of MuJoCo that returns nothing: name and number of arguments."""
mj_step = native("mj_step", 2)
mj_kinematics = native("mj_kinematics", 2)
mj_collision = native("mj_collision", 2)
mj_com_pos = native("mj_comPos", 2)
mj_flex = native("mj_flex", 2)
mj_tendon = native("mj_tendon", 2)
mj_make_m = native("mj_makeM", 2)
mj_transmission = native("mj_transmission", 2)
mj_fwd_velocity = native("mj_fwdVelocity", 2)
mj_jac = native("mj_jac", 6)
mj_jac_dot = native("mj_jacDot", 6)
mj_get_state = native("mj_getState", 4)
mju_mat_to_quat = native("mju_mat2Quat", 2)
mju_mul_quat = native("mju_mulQuat", 3)
mj_set_state = native("mj_setState", 4)
mj_update_sleep = native("mj_updateSleep", 2)


def compute_state_size(model: mujoco.MjModel) -> int:
    """Return the number of values in the state of a simulation."""
    return int(mujoco.mj_stateSize(model, INTEGRATION)) + int(model.ntree)


def view_state(model: mujoco.MjModel, data: mujoco.MjData, state: Array) -> None:
    """Set `data` to a saved state, without restoring which bodies sleep.

    This is enough to read poses. No body in `data` may be asleep.
    """
    end = mujoco.mj_stateSize(model, INTEGRATION)
    mujoco.mj_setState(model, data, np.ascontiguousarray(state[:end]), INTEGRATION)


def build_common_view(*arrays: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return one view of the memory that spans several arrays of one `MjData`.

    The view is valid as long as the data exists.

    Returns:
        The view, and for each array the index in the view at which it begins.
    """
    begins = np.array([array.ctypes.data for array in arrays])
    ends = [int(begin) + array.nbytes for begin, array in zip(begins, arrays, strict=True)]
    start = int(begins.min())
    item = np.dtype(np.float64).itemsize
    return (
        _build_view(start, np.float64, ((max(ends) - start) // item,), (item,)),
        (begins - start) // item,
    )


def set_margins(model: mujoco.MjModel, margins: ArrayLike) -> None:
    """Set the margins of geoms, so that MuJoCo finds pairs within the sum of their margins.

    MuJoCo first excludes pairs of bodies, using margins of bodies that its compiler has set. The
    margins of the bodies are therefore set as well. `margins` is (geoms,), or one value for all
    geoms, in m.
    """
    model.geom_margin[:] = margins
    model.body_margin[:] = 0.0
    np.maximum.at(model.body_margin, model.geom_bodyid, model.geom_margin)


class ContactViews(NamedTuple):
    """Views of the contacts of an `MjData`, valid as long as the data."""

    number: NDArray[np.int32]  # (1,)
    geoms: NDArray[np.int32]  # (capacity, 2), of which the first `number` are contacts
    distance: Array  # (capacity,), m: distances of the contacts, in the same order


def build_contact_views(model: mujoco.MjModel, data: mujoco.MjData) -> ContactViews:
    """Return views of the number, geoms and distances of the contacts.

    MuJoCo's bindings only return a copy of the number, and arrays that are valid until the contacts
    change. In memory, however, contacts are always at the start of the arena, and their number
    follows warnings and timers (mjdata.h).

    Raises:
        RuntimeError: This version of MuJoCo stores the number of contacts elsewhere.
    """
    state = np.zeros(mujoco.mj_stateSize(model, INTEGRATION))
    mujoco.mj_getState(model, data, state, INTEGRATION)
    warnings = data.warning.number
    timers = data.timer.number
    end = warnings.ctypes.data - warnings.itemsize + len(warnings) * warnings.strides[0]
    number = _build_view(end + len(timers) * timers.strides[0], np.int32, (1,), (4,))
    before = int(number[0])
    # Without any contact, the arrays of contacts have no address.
    mujoco.mj_addContact(model, data, mujoco.MjContact())
    if not before + 1 == number[0] == data.ncon:
        raise RuntimeError(
            f"MuJoCo {mujoco.mj_versionString()} does not store the number of contacts where 4.0"
            " does"
        )
    geoms = data.contact.geom
    distance = data.contact.dist
    capacity = data.narena // geoms.strides[0]
    strides = geoms.strides
    views = ContactViews(
        number,
        _build_view(geoms.ctypes.data, np.int32, (capacity, 2), strides),
        _build_view(distance.ctypes.data, np.float64, (capacity,), strides[:1]),
    )
    mujoco.mj_forward(model, data)  # removes the added contact
    mujoco.mj_setState(model, data, state, INTEGRATION)
    return views


def _build_view(
    address: int, kind: type, shape: tuple[int, ...], strides: tuple[int, ...]
) -> NDArray[Any]:
    """Return an array of type `kind` that views the memory at `address`."""
    memory = (ctypes.c_char * (shape[0] * strides[0])).from_address(address)
    return np.ndarray(shape, kind, memoryview(memory), 0, strides)


@compiled
def add_offset(tool: Array, turned: Array, offset: Array, place: Array) -> None:
    """Add an offset in the frame of the tool to the position of the tool.

    Args:
        tool: Position of the tool, (3,), m.
        turned: Rotation matrix of the tool, (9,).
        offset: Offset in the frame of the tool, (3,) or more, m.
        place: Receives the position in its first three elements, m.
    """
    for i in range(3):
        of = turned[3 * i : 3 * i + 3]
        place[i] = tool[i] + (of[0] * offset[0] + of[1] * offset[1] + of[2] * offset[2])
