"""Runs without faults report nothing: whole tasks, missed cycles and restarted boards."""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.message import State
from rack.backplane.watch.alarms import Alarm
from rack.boards.config import load
from rack.levels.level import Finding
from tests.levels.whole_rack import WholeRack

BRAKES = (Alarm.BRAKES_CLOSED, Alarm.BRAKES_OPENED)

pytestmark = pytest.mark.timeout(
    300
)  # half a minute of an arm's time each, on a machine that others use as well


def run(rack: WholeRack, most_s: float, seed: int | None = None) -> list[tuple[int, Finding]]:
    """Run to the end of the task; with a seed, cycles are missed and boards start anew at
    random."""
    found: list[tuple[int, Finding]] = []
    rng = np.random.default_rng(seed)
    while rack.seconds < most_s and rack.task.state not in (State.DONE, State.ERROR):
        for _ in range(100):
            if seed is not None and rng.random() < 0.002:
                rack.tasks["servo"].due += int(rng.choice([1, 2, 3, 5, 8, 20]))
            if seed is not None and rng.random() < 0.0005:
                rack.restart(str(rng.choice(["servo", "servo.planner", "world", "task.planner"])))
            rack.step()
            servo = rack.tasks["servo"].level
            found += [
                (rack.tick - 1, finding)
                for finding in servo.findings
                if finding.alarm not in BRAKES
            ]
            servo.findings.clear()
    return found


@pytest.mark.slow
def test_a_whole_task_finds_nothing_and_breaks_no_limit() -> None:
    rack = WholeRack("k1607", motion=load("k1607").scene.motion)
    assert run(rack, 60.0) == []
    assert rack.task.state == State.DONE
    assert (rack.read("servo.status").violations, rack.read("servo.status").touches) == (0, 0)


@pytest.mark.slow
def test_missed_cycles_and_restarted_boards_are_not_faults_of_the_arm() -> None:
    rack = WholeRack("nasrem", motion=load("nasrem").scene.motion)
    assert run(rack, 15.0, seed=1) == []
    assert rack.read("servo.status").violations == 0
