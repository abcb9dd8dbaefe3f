"""The modules of the example `can-arm`, and its arm in simulated time."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import can
import pytest

from rack.backplane.watch.alarms import Alarm
from tests.can_arm.rig import EXAMPLE, DrivenRig

MODULES = ("can_arm", "can_drives", "cable", "drive", "mechanics", "wire")


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[Any]:
    """The modules of the example, by name; its bus is within this process."""
    monkeypatch.syspath_prepend(EXAMPLE)
    monkeypatch.setenv("CAN_INTERFACE", "virtual")
    monkeypatch.setenv("CAN_CHANNEL", request.node.name)
    modules = SimpleNamespace(**{name: importlib.import_module(name) for name in MODULES})
    open_bus = modules.wire.open_bus
    buses: list[can.BusABC] = []

    def opened() -> can.BusABC:
        buses.append(open_bus())
        return buses[-1]

    monkeypatch.setattr(modules.wire, "open_bus", opened)
    yield modules
    for bus in buses:
        bus.shutdown()
    for name in MODULES:
        sys.modules.pop(name, None)


@pytest.fixture
def rig(example: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> DrivenRig:
    return DrivenRig(example, tmp_path, monkeypatch)


@pytest.fixture
def swinging(rig: DrivenRig) -> DrivenRig:
    """One whose arm moves."""
    rig.swing(300)
    assert rig.alarms() == [Alarm.BRAKES_OPENED]
    return rig
