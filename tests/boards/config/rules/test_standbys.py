"""Standbys that a rack cannot have are refused before the launch, each with one line."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import pytest

from rack.boards.config.resolved import resolve
from tests.boards.config.mistakes import find_mistake
from tests.boards.conftest import PLANNED, MakeConfig

HARDWARE = Path(__file__).parents[4] / "configs/examples/own-hardware/hardware.toml"
CORES = ", ".join(map(str, range(os.cpu_count() or 1)))
ONE = "{slot=9,core=0}"
WAVE = f"board.wave.standby={ONE}"
CASES: Mapping[str, tuple[tuple[str, ...], str]] = {
    "its own slot": (
        ("board.wave.standby={slot=2}",),
        "board.wave.standby.slot = 2: the slot is already taken by board.wave.slot",
    ),
    "a slot twice": (
        ("board.wave.standby=[{slot=9},{slot=9}]",),
        "board.wave.standby[1].slot = 9: the slot is already taken by board.wave.standby[0].slot",
    ),
    "no such core": (
        ("board.wave.standby={slot=9,core=900}",),
        f"board.wave.standby.core = 900: this machine has no such core; cores: {CORES}",
    ),
    "two copies vote": (
        (WAVE, "board.wave.vote=true"),
        "board.wave.vote = true: a vote needs 3 copies, but there are 2; give 2 standbys",
    ),
    "too many": (
        ("board.wave.standby=[{slot=9},{slot=10},{slot=11}]",),
        "board.wave.standby: 3 standbys; at most 2 are possible",
    ),
    "nothing to compare with": (
        ("board.wave.compare=true",),
        "board.wave.compare = true: needs board.wave.standby, which is missing",
    ),
    "protocol": (
        (WAVE, "protocol.default=lock"),
        "board.wave.standby: mailbox 'wave.status' has protocol lock; all mailboxes of a level with"
        " a standby need time-slice or double-buffer",
    ),
    "scheduler": (
        (WAVE, "clock.scheduler=fixed-priority"),
        "board.wave.standby: the config names a scheduler; a standby needs fixed priorities",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_standby_that_cannot_be_is_refused_with_one_line(case: str) -> None:
    settings, line = CASES[case]
    assert find_mistake(PLANNED, *settings) == line


def test_an_arm_that_is_not_simulated_has_one_process() -> None:
    found = find_mistake(HARDWARE, f"board.servo.standby={ONE}")
    assert "is not a simulation, and one process must drive it" in found


def test_a_standby_follows_all_tasks_and_copies_its_wiring(config: MakeConfig) -> None:
    plain = resolve(config(text=PLANNED))
    found = resolve(config(WAVE, text=PLANNED))
    *tasks, standby = found.layout.tasks
    assert [task.name for task in tasks] == [task.name for task in plain.layout.tasks]
    assert (standby.name, standby.board, standby.role) == ("wave.standby", "wave", "standby")
    assert (standby.slot, standby.core, standby.every) == (9, 0, tasks[0].every)
    assert found.layout.list_copies("wave") == (tasks[0], standby)
    first, *_, last = found.tasks
    assert (last.target, last.inputs, last.outputs) == (first.target, first.inputs, first.outputs)
    assert [box.name for box in found.layout.timed] == [box.name for box in plain.layout.timed]
