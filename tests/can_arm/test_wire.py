"""Frames of the example `can-arm`, and the bus that they go over."""

from __future__ import annotations

import importlib
import sys
from typing import Any

import can
import numpy as np
import pytest

from rack.levels.errors import LevelError
from tests.can_arm.rig import EXAMPLE, DrivenRig


def test_a_command_and_a_report_come_out_as_they_went_in(example: Any) -> None:
    wire = example.wire
    torque = np.array([1.5, -800.0, 1e6])
    data = wire.command(7, [wire.Control.SWITCH_ON] * 3, torque)
    assert (len(data), wire.read_tick(data)) == (wire.SIZES[wire.COMMAND], 7)
    orders = np.frombuffer(data, wire.ORDER, 3, wire.TICK.size)
    assert orders["control"].tolist() == [7, 7, 7]
    # The last is beyond the range of the wire.
    assert (orders["torque"] * wire.UNIT).tolist() == [1.5, -800.0, wire.MOST * wire.UNIT]
    report = wire.Report(9, wire.Power.SWITCHED_ON, wire.TOO_HOT, -3_141_592, 5)
    assert wire.Report(*wire.REPORT.unpack(wire.REPORT.pack(*report))) == report


def test_only_whole_frames_of_known_kinds_come_in(example: Any) -> None:
    wire = example.wire
    with wire.open_bus() as here, wire.open_bus() as there:
        for identifier, data in ((0x080, b"abc"), (0x181, b"short"), (0x321, bytes(8))):
            there.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        there.send(can.Message(arbitration_id=0x181, data=bytes(16), is_fd=True))  # extended
        wire.send(there, wire.STATUS, 5, bytes(16))
        assert [frame[:3] for frame in wire.receive(here)] == [(wire.STATUS, 5, bytes(16))]


def test_a_bus_that_cannot_be_opened_is_one_line(
    example: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAN_INTERFACE", "udp_multicast")
    monkeypatch.setenv("CAN_CHANNEL", "10.0.0.1")
    with pytest.raises(LevelError, match=r"^cannot open the bus 10\.0\.0\.1: [^\n]+$"):
        example.wire.open_bus()


def test_without_python_can_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLE)
    monkeypatch.setitem(sys.modules, "can", None)
    with pytest.raises(LevelError, match=r"needs python-can: pip install 'nasrem-rack\[can\]'$"):
        importlib.import_module("wire")
    assert "wire" not in sys.modules


@pytest.mark.slow
def test_a_drive_takes_no_frame_of_another_node_for_the_racks(example: Any, rig: DrivenRig) -> None:
    wire = example.wire
    rig.run(5)
    before = rig.arm.sense().tick
    rig.rack.lose("servo", 100)
    # CANopen's emergency object of node 2, and a command of its own.
    for kind in (wire.SYNC, wire.COMMAND):
        rig.send(kind, 2, bytes(64))
    with wire.open_bus() as bus:
        rig.step()
        assert {frame.kind for frame in wire.receive(bus)} <= {wire.HEARTBEAT}
    assert before == rig.arm.sense().tick
