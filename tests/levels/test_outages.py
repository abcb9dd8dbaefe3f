"""The whole rack when boards are lost and come back and mailboxes fail, at any time: the task is
done all the same.

Boards are lost as in a rack: their messages stay, readers see the loss, the new process is on the
grid.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from rack.backplane.message import State
from rack.boards.config import load
from rack.levels.level import Finding
from rack.levels.messages import Verb
from tests.levels.box import Disturbance, SwapPairs, hold_back, lose_some, mute
from tests.levels.lockstep import CLOCK_NS
from tests.levels.servo.rig import BRAKES
from tests.levels.whole_rack import WholeRack

pytestmark = pytest.mark.slow

TRANSFER = {"do": "transfer", "object": "block1", "to": [0.50, -0.20, 0.475]}
BLOCK1 = 0
SECOND = 1_000_000_000 // CLOCK_NS
"""One, in ticks."""
NOMINAL = 14 * SECOND
"""Ticks that the transfer takes when nothing happens."""
MAILBOXES = (
    *("servo.status", "servo.scene", "primitive.command", "primitive.status", "world.model"),
    *("elemental_move.command", "elemental_move.status", "elemental_move.plan", "task.command"),
)


def check(rack: WholeRack) -> None:
    """Assert that the task is done, without harm to arm or cell."""
    status = rack.run_to_end(40.0)
    assert (status.state, status.reason) == (State.DONE, "")
    servo = rack.read("servo.status")
    assert (servo.touches, servo.clipped, servo.violations) == (0, 0, 0)
    assert rack.read("world.model").position[BLOCK1] == pytest.approx(TRANSFER["to"], abs=0.003)


@pytest.mark.parametrize("seed", [1, pytest.param(2, marks=pytest.mark.thorough)])
def test_the_task_is_done_in_spite_of_any_lost_boards(seed: int) -> None:
    chance = np.random.default_rng(seed)
    rack = WholeRack(actions=[TRANSFER])
    for _ in range(8):
        name, finished = str(chance.choice(sorted(rack.tasks))), bool(chance.random() < 0.5)
        ticks = int(np.exp(chance.uniform(0.0, np.log(2 * SECOND))))
        at = int(chance.integers(NOMINAL))
        rack.after(at, partial(rack.lose, name, ticks, finished))
    check(rack)


@pytest.mark.thorough
def test_the_task_is_done_in_spite_of_lost_delayed_or_reordered_messages() -> None:
    chance = np.random.default_rng(3)
    rack = WholeRack(actions=[TRANSFER])
    for mailbox in chance.permutation(MAILBOXES):
        every = rack.tasks[mailbox.partition(".")[0]].spec.every
        seed = int(chance.integers(1 << 30))
        delayed = hold_back(every * int(chance.integers(2, 6)))
        kinds: list[Disturbance] = [mute, lose_some(0.5, seed), delayed, SwapPairs(0.5, seed)]
        fault = kinds[int(chance.integers(len(kinds)))]
        ticks = max(int(chance.uniform(1.0, 2.0) * SECOND), 4 * every)
        at = int(chance.integers(NOMINAL))
        rack.after(at, partial(rack.disturb, str(mailbox), fault, ticks))
    check(rack)


@pytest.mark.thorough
def test_the_object_stays_in_the_gripper_while_all_boards_that_hold_it_are_lost() -> None:
    rack = WholeRack(actions=[TRANSFER])

    def is_carried(_: object) -> bool:
        shown = rack.move.held, rack.move.verb, bool(rack.primitive.resting)
        return shown == (BLOCK1, Verb.MOVE, False)

    assert rack.run(15.0, is_carried)
    for name in ("servo", "primitive", "world"):
        rack.lose(name, SECOND)
    rack.run(0.9)
    assert rack.read("primitive.status").held == BLOCK1
    check(rack)


def run(rack: WholeRack, most_s: float, seed: int | None = None) -> list[tuple[int, Finding]]:
    """Run the task to its end; with a seed, cycles are missed and boards restart at random."""
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
            new = (finding for finding in servo.findings if finding.alarm not in BRAKES)
            found += [(rack.tick - 1, finding) for finding in new]
            servo.findings.clear()
    return found


@pytest.mark.thorough
def test_a_whole_task_finds_nothing_and_breaks_no_limit() -> None:
    rack = WholeRack("k1607", motion=load("k1607").scene.motion)
    assert run(rack, 60.0) == []
    assert rack.task.state == State.DONE
    assert (rack.read("servo.status").violations, rack.read("servo.status").touches) == (0, 0)


@pytest.mark.thorough
def test_missed_cycles_and_restarted_boards_are_not_faults_of_the_arm() -> None:
    rack = WholeRack("nasrem", motion=load("nasrem").scene.motion)
    assert run(rack, 15.0, seed=1) == []
    assert rack.read("servo.status").violations == 0
