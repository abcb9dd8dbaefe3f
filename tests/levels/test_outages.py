"""The whole rack when boards are lost and come back and mailboxes fail, at any time: the task is
done all the same.

Boards are lost as in a rack: their messages stay, readers see the loss, the new process is on the
grid.
"""

from __future__ import annotations

import numpy as np
import pytest

from rack.backplane.message import State
from rack.levels.messages import Verb
from tests.levels.box import Disturbance, SwapPairs, hold_back, lose_some, mute
from tests.levels.lockstep import CLOCK_NS
from tests.levels.whole_rack import WholeRack

pytestmark = pytest.mark.slow

TRANSFER = {"do": "transfer", "object": "block1", "to": [0.50, -0.20, 0.475]}
BLOCK1 = 0
SECOND = 1_000_000_000 // CLOCK_NS
"""One, in ticks."""
NOMINAL = 14 * SECOND
"""Ticks that the transfer takes when nothing happens."""
MAILBOXES = (
    "servo.status",
    "servo.scene",
    "primitive.command",
    "primitive.status",
    "elemental_move.command",
    "elemental_move.status",
    "elemental_move.plan",
    "task.command",
    "world.model",
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
        rack.after(
            at, lambda name=name, ticks=ticks, finished=finished: rack.lose(name, ticks, finished)
        )
    check(rack)


def draw_disturbance(chance: np.random.Generator, every: int) -> Disturbance:
    """Draw a fault of a writer that writes every so many ticks."""
    seed = int(chance.integers(1 << 30))
    kinds = (
        mute,
        lose_some(0.5, seed),
        hold_back(every * int(chance.integers(2, 6))),
        SwapPairs(0.5, seed),
    )
    return kinds[int(chance.integers(len(kinds)))]


def test_the_task_is_done_in_spite_of_lost_delayed_or_reordered_messages() -> None:
    chance = np.random.default_rng(3)
    rack = WholeRack(actions=[TRANSFER])
    for mailbox in chance.permutation(MAILBOXES):
        every = rack.tasks[mailbox.partition(".")[0]].spec.every
        fault, ticks = (
            draw_disturbance(chance, every),
            max(int(chance.uniform(1.0, 2.0) * SECOND), 4 * every),
        )
        at = int(chance.integers(NOMINAL))
        rack.after(
            at, lambda name=str(mailbox), fault=fault, ticks=ticks: rack.disturb(name, fault, ticks)
        )
    check(rack)


def test_the_object_stays_in_the_gripper_while_all_boards_that_hold_it_are_lost() -> None:
    rack = WholeRack(actions=[TRANSFER])
    assert rack.run(
        15.0,
        lambda _: (
            rack.move.held == BLOCK1 and rack.move.verb == Verb.MOVE and not rack.primitive.resting
        ),
    )
    for name in ("servo", "primitive", "world"):
        rack.lose(name, SECOND)
    rack.run(0.9)
    assert rack.read("primitive.status").held == BLOCK1
    check(rack)
