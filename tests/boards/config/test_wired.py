"""What the shipped racks are wired to be, and how they are timed: nothing of it changes unseen."""

from __future__ import annotations

import os

import pytest

from rack.boards.config import load, resolve
from rack.boards.config.timing import build_rack_timing
from tests.snapshots import ROOT, SHIPPED, Snapshots, each_shipped_rack

SNAPSHOTS = Snapshots(__file__)


@pytest.fixture(autouse=True)
def _on_four_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {0, 1, 2, 3})


@each_shipped_rack
def test_a_shipped_rack_is_wired_as_before(name: str) -> None:
    rack = resolve(load(ROOT / "configs" / name))
    lockstep = resolve(load(ROOT / "configs" / name, ["clock.mode=lockstep"]))
    parts = {
        "layout": rack.layout,
        "tasks": rack.tasks,
        "hosts": rack.hosts,
        "faults": rack.faults,
        "commands": rack.commands,
        "goals": rack.goals,
        "clock": (
            rack.build_clock_wiring(None),
            rack.build_clock_wiring(3.0),
            lockstep.build_clock_wiring(None),
        ),
        "crate": (rack.crate_priority, rack.ends_run),
        "timing": build_rack_timing(rack.config, rack.layout),
    }
    SNAPSHOTS.check(name, parts)


def test_every_shipped_rack_is_in_the_file_and_no_other() -> None:
    assert SNAPSHOTS.known.keys() == set(SHIPPED)
