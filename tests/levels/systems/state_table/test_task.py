"""The task level as a state table, cycle by cycle: its plan goes down step by step, and goes on
after a restart."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import pytest

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import Message, State
from rack.boards.config import resolve
from rack.boards.config.resolved import load
from rack.levels.level import LevelContext, Ports
from rack.levels.operator import OPERATOR_COMMAND
from rack.levels.systems.state_table.elemental_move import MOVE_TABLE_STATUS
from rack.levels.systems.state_table.level import WORD_COMMAND
from rack.levels.systems.state_table.task import TASK_TABLE_STATUS, TaskPlanConfig, TaskTable

STEPS = [
    *("pick block1", "place right", "pick peg", "place left", "pick block2", "place corner"),
    "home",
]


@pytest.fixture(scope="module")
def context() -> LevelContext:
    plan = resolve(load("nist-state-table", ["clock.mode=lockstep"]))
    return next(wiring.context for wiring in plan.tasks if wiring.task == "task")


class Bench:
    """The task level and its mailboxes, without a bus; the level below answers as the test has
    it."""

    def __init__(self, context: LevelContext) -> None:
        self.context = context
        self.below = Message(MOVE_TABLE_STATUS.dtype({}))
        self.is_lost = False
        self.last = Reading(Message(TASK_TABLE_STATUS.dtype({})), Verdict.NONE)
        self.sent = Reading(Message(WORD_COMMAND.dtype({})), Verdict.NONE)
        self.begin()

    def begin(self) -> None:
        """Start the board."""
        self.write = Ports(
            command=Message(WORD_COMMAND.dtype({})), status=Message(TASK_TABLE_STATUS.dtype({}))
        )
        self.level = TaskTable(self.context)

    def restart(self) -> None:
        """Start the board again: it finds its own last messages."""
        self.last = Reading(self.write.status, Verdict.NEW)
        self.sent = Reading(self.write.command, Verdict.NEW)
        self.begin()

    def cycle(self) -> tuple[str, str]:
        """Do one cycle; return state and command."""
        none = Reading(Message(OPERATOR_COMMAND.dtype({})), Verdict.NONE)
        read = Ports(
            status=Reading(self.below, Verdict.NEW, self.is_lost),
            operator=none,
            last_status=self.last,
            last_command=self.sent,
        )
        self.level.process(read, self.write, 0)
        return self.write.status.in_state, self.write.command.words

    def answer(self, state: State) -> tuple[str, str]:
        """Let the level below answer the newest command; do one cycle."""
        self.below.echo = self.write.command.id
        self.below.state = state
        return self.cycle()

    @property
    def progress(self) -> tuple[int, int, int, int, int]:
        """Serial of the newest command, steps done and of how many, the same in commands."""
        shown = self.write.status
        return shown.sent, shown.action, shown.actions, shown.moves_done, shown.moves


@pytest.fixture
def bench(context: LevelContext) -> Bench:
    return Bench(context)


def test_the_steps_go_down_one_after_the_other(bench: Bench) -> None:
    assert bench.cycle() == ("picking", STEPS[0])
    assert bench.progress == (1, 0, 3, 0, 6)
    # It has not answered the newest command.
    assert bench.cycle() == ("picking", STEPS[0])
    commands = [bench.write.command.words]
    for answer in (State.EXECUTING, State.DONE) * 12:
        bench.answer(answer)
        if bench.write.command.words != commands[-1]:
            commands.append(bench.write.command.words)
    assert bench.write.status.state == State.DONE
    assert commands == STEPS
    assert bench.progress == (7, 3, 3, 6, 6)
    assert bench.write.command.id == 7


def test_what_was_not_picked_is_tried_once_more_and_then_given_up(bench: Bench) -> None:
    bench.cycle()
    assert bench.answer(State.ERROR) == ("retreating", "home")
    assert bench.answer(State.DONE) == ("picking-again", STEPS[0])
    assert bench.progress == (3, 0, 3, 0, 6)
    assert bench.answer(State.ERROR)[0] == "failed"
    assert (bench.write.status.state, bench.write.status.reason) == (
        State.ERROR,
        "the level below failed twice, or on the way",
    )


def test_a_restarted_board_goes_on_with_the_step_under_way(bench: Bench) -> None:
    bench.cycle()
    bench.is_lost = True
    assert bench.answer(State.DONE) == ("picking", STEPS[0])
    bench.is_lost = False
    for _ in range(3):
        bench.answer(State.DONE)
    assert bench.cycle() == ("picking", STEPS[2])
    assert bench.progress == (3, 1, 3, 2, 6)
    bench.restart()
    assert bench.cycle() == ("picking", STEPS[2])
    assert bench.progress == (3, 1, 3, 2, 6)
    assert bench.write.command.id == 3
    assert bench.answer(State.DONE) == ("placing", STEPS[3])
    assert bench.progress[0] == 4


def test_objects_that_the_scene_lacks_are_named() -> None:
    plan = TaskPlanConfig.model_validate(
        {"step": [{"object": "a", "place": "x"}, {"object": "b", "place": "x"}]}
    )
    scene = cast("object", SimpleNamespace(objects=["a", "c"]))
    assert TaskTable.plan_flaws(scene, plan) == [  # type: ignore[arg-type]
        "plan.step[1].object: unknown 'b'; objects: a, c"
    ]
    empty = cast("object", SimpleNamespace(objects=[]))
    assert TaskTable.plan_flaws(empty, plan)[0].endswith("objects: none")  # type: ignore[arg-type]
