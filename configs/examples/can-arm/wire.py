"""Frames between the rack and the drives, modelled on CiA 301 and CiA 402.

| identifier | from, when | data |
|---|---|---|
| 0x080 + 0 | rack, every tick | SYNC: tick |
| 0x180 + node | drive, on SYNC | a `Report` |
| 0x200 + 0 | rack, every tick | tick; an order for each drive in turn |
| 0x600 + node | anyone | disturbance: see `disturb.py` |
| 0x700 + node | drives and rack, every 100 ms | heartbeat: state of the node |

One command for all drives, from which each takes its order, halves the load: 9 CAN FD frames per
tick with seven joints.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import suppress
from enum import IntEnum
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rack.levels.errors import LevelError

try:
    import can
except ModuleNotFoundError as error:
    raise LevelError("this arm needs python-can: pip install 'nasrem-rack[can]'") from error

RACK = 127
"""Node of the rack, the highest. The nodes of the drives start at 1."""
SYNC, STATUS, COMMAND, DISTURB, HEARTBEAT = 0x080, 0x180, 0x200, 0x600, 0x700
BOOTED, OPERATIONAL = b"\x00", b"\x05"
"""Heartbeat data: states of a node."""
HEARTBEAT_S = 0.1
SILENT_S = 0.5
"""Time without a heartbeat after which a node is lost."""
LOCAL: dict[str, Any] = {"interface": "udp_multicast", "channel": "239.74.163.2", "hop_limit": 0}
"""Default bus: UDP multicast that does not leave this machine."""
UNIT = 1e-6
"""Resolution of the integers for positions (rad), velocities (rad/s) and torques (N m)."""
MOST = 2**31 - 1
TICK = struct.Struct("<I")
ORDER = np.dtype([("control", "<u2"), ("torque", "<i4")])
Orders = NDArray[np.void]
"""Array of ORDER, (drives,)."""
MOST_DRIVES = 10
REPORT = struct.Struct("<IHHii")
SPAN = struct.Struct("<Bff")
SIZES = {SYNC: 4, STATUS: REPORT.size, COMMAND: 64, DISTURB: SPAN.size, HEARTBEAT: 1}
"""Sizes of the data, bytes. Shorter frames and other kinds are dropped."""
MOST_FRAMES = 64
"""Largest number of frames read at once, so that a flooded bus cannot block its readers."""


class Power(IntEnum):
    """States of a drive, as status words. The brake is released only in OPERATION_ENABLED."""

    FAULT = 0x08
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27


class Control(IntEnum):
    """Control words."""

    DISABLE_VOLTAGE = 0x00
    SHUT_DOWN = 0x06
    SWITCH_ON = 0x07  # and "disable operation"
    ENABLE_OPERATION = 0x0F
    RESET_FAULT = 0x80


FAULTS = {0x4310: "too hot", 0x8130: "no heartbeat from the rack", 0x8140: "was off the bus"}
TOO_HOT, NO_HEARTBEAT, BUS_OFF = FAULTS
"""Error codes. 0 means no error."""


class Report(NamedTuple):
    """Report of a drive."""

    tick: int  # of the SYNC
    power: int
    fault: int
    position: int  # UNIT
    velocity: int  # UNIT


class Frame(NamedTuple):
    """A frame that was received."""

    kind: int
    node: int
    data: bytes
    time_s: float  # of its arrival, seconds since the epoch


def open_bus() -> can.BusABC:
    """Open the bus that the environment names (CAN_INTERFACE, CAN_CHANNEL), by default `LOCAL`.

    Raises `LevelError`.
    """
    settings = {**LOCAL, **can.util.load_environment_config()}
    try:
        return can.Bus(**settings, fd=True, ignore_config=True)
    except (can.CanError, OSError) as error:
        why = error.__cause__ or error
        raise LevelError(f"cannot open the bus {settings['channel']}: {why}") from error


def send(bus: can.BusABC, kind: int, node: int, data: bytes) -> None:
    """Send a frame without blocking. A frame that the bus rejects is lost.

    Args:
        bus: The bus.
        kind: First identifier of this kind of frame, to which the node is added.
        node: Node that sends the frame, or to which it is addressed.
        data: Content. More than 8 bytes need CAN FD.
    """
    is_fd = len(data) > 8
    with suppress(can.CanError):
        bus.send(can.Message(0.0, kind + node, False, data=data, is_fd=is_fd), 0)


def receive(bus: can.BusABC) -> Iterator[Frame]:
    """Yield up to `MOST_FRAMES` frames that have arrived, without blocking."""
    for _ in range(MOST_FRAMES):
        try:
            message = bus.recv(0)
        except can.CanError:
            continue
        if message is None:
            return
        node = message.arbitration_id & RACK
        kind = message.arbitration_id - node
        is_data = not (message.is_error_frame or message.is_extended_id)
        if is_data and len(message.data) >= SIZES.get(kind, MOST):
            yield Frame(kind, node, bytes(message.data), message.timestamp)


def command(tick: int, control: Sequence[int], torque: NDArray[np.float64]) -> bytes:
    """Return the data of a command.

    Args:
        tick: Tick of the command.
        control: Control word of each drive.
        torque: Torque of each drive, (drives,), in N m.
    """
    orders = np.zeros(MOST_DRIVES, ORDER)
    orders["control"][: len(control)] = control
    orders["torque"][: len(control)] = np.clip(torque / UNIT, -MOST, MOST)
    return TICK.pack(tick) + orders.tobytes()


def read_tick(data: bytes) -> int:
    """Return the tick of a SYNC or a command."""
    tick: int = TICK.unpack_from(data)[0]
    return tick
