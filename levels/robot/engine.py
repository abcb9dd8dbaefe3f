"""MuJoCo's own functions and memory, for compiled code.

Called from Python, a step of MuJoCo costs 2 us more than it takes, and a look at its contacts half
a microsecond: both happen at every step. Compiled code calls the C library directly, on the
addresses of model and data. Called as Python, the same code reaches the same functions through
ctypes.

Of an error that MuJoCo calls fatal (its memory is exhausted) the bindings would make an exception;
here it ends the process, as the exception would have ended the board.

The state of a simulation is everything that its next step depends on. MuJoCo's integration state
does not say which bodies sleep, so that follows it. What lies at rest sleeps until something awake
touches it: in `nasrem` its blocks take two thirds of the time of a step while they are awake. A
simulation restored from this state continues bit for bit, asleep or awake.
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
from rack.levels.compiled import c_function

INTEGRATION = int(mujoco.mjtState.mjSTATE_INTEGRATION)
SLEEP = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
LIBRARY = str(Path(mujoco.__file__).with_name(f"libmujoco.so.{mujoco.mj_versionString()}"))


native = partial(c_function, LIBRARY)
"""A function of MuJoCo that returns nothing, by its name and its number of arguments."""
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


def state_size(model: mujoco.MjModel) -> int:
    """Return the length of a state."""
    return int(mujoco.mj_stateSize(model, INTEGRATION)) + int(model.ntree)


def view_state(model: mujoco.MjModel, data: mujoco.MjData, state: Array) -> None:
    """Set `data`, of which nothing sleeps, to a state but for sleep: enough to look at it."""
    end = mujoco.mj_stateSize(model, INTEGRATION)
    mujoco.mj_setState(model, data, np.ascontiguousarray(state[:end]), INTEGRATION)


def one_view(*arrays: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return the memory from the first to the last of some arrays of one `MjData`, and where in it
    each begins.

    It is valid as long as the data.
    """
    begins = np.array([array.ctypes.data for array in arrays])
    ends = [int(begin) + array.nbytes for begin, array in zip(begins, arrays, strict=True)]
    first = int(begins.min())
    item = np.dtype(np.float64).itemsize
    return (
        _view(first, np.float64, ((max(ends) - first) // item,), (item,)),
        (begins - first) // item,
    )


def set_margins(model: mujoco.MjModel, margins: ArrayLike) -> None:
    """Have geoms find each other at the sum of their `margins`, (geoms,) or one for all, m.

    MuJoCo rules out bodies first, by margins of their own, which its compiler sets.
    """
    model.geom_margin[:] = margins
    model.body_margin[:] = 0.0
    np.maximum.at(model.body_margin, model.geom_bodyid, model.geom_margin)


class ContactViews(NamedTuple):
    """Views of the contacts of an `MjData`, valid as long as it is."""

    number: NDArray[np.int32]  # (1,)
    geoms: NDArray[np.int32]  # (room, 2), of which the first `number` are contacts
    distance: Array  # (room,), m; likewise


def contact_views(model: mujoco.MjModel, data: mujoco.MjData) -> ContactViews:
    """Return views of the contacts. Raises `RuntimeError` for a MuJoCo that keeps them in another
    place.

    The bindings give a copy of their number, and views of the contacts of one moment. But contacts
    always begin the arena, and their number follows warnings and timers (mjdata.h).
    """
    state = np.zeros(mujoco.mj_stateSize(model, INTEGRATION))
    mujoco.mj_getState(model, data, state, INTEGRATION)
    warnings = data.warning.number
    timers = data.timer.number
    end = warnings.ctypes.data - warnings.itemsize + len(warnings) * warnings.strides[0]
    number = _view(end + len(timers) * timers.strides[0], np.int32, (1,), (4,))
    before = int(number[0])
    mujoco.mj_addContact(
        model, data, mujoco.MjContact()
    )  # where there are no contacts, they have no address
    if not before + 1 == number[0] == data.ncon:
        raise RuntimeError(
            f"MuJoCo {mujoco.mj_versionString()} does not keep the number of contacts where 4.0"
            " does"
        )
    geoms = data.contact.geom
    distance = data.contact.dist
    room = data.narena // geoms.strides[0]
    strides = geoms.strides
    views = ContactViews(
        number,
        _view(geoms.ctypes.data, np.int32, (room, 2), strides),
        _view(distance.ctypes.data, np.float64, (room,), strides[:1]),
    )
    mujoco.mj_forward(model, data)  # without the contact added
    mujoco.mj_setState(model, data, state, INTEGRATION)
    return views


def _view(
    address: int, kind: type, shape: tuple[int, ...], strides: tuple[int, ...]
) -> NDArray[Any]:
    """Return the array at `address`."""
    memory = (ctypes.c_char * (shape[0] * strides[0])).from_address(address)
    return np.ndarray(shape, kind, memoryview(memory), 0, strides)
