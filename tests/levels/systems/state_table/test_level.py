"""A level that follows a state table: the row that fires, the status, the state after a restart."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import Message, State
from rack.levels.level import LevelContext
from rack.levels.messages import Error
from rack.levels.operator import Answer, Operation, OperatorCommand
from rack.levels.systems.state_table.level import (
    StateTableExecutor,
    TableCommand,
    TableStatus,
    classify_answer,
)
from rack.levels.systems.state_table.table import Lexicon
from rack.levels.tables import SceneConfig
from tests.levels.systems.state_table.tables import DOOR, DOORS, LEXICON

TICK_NS = 10_000_000
PATIENCE_TICKS = 5


class Door(StateTableExecutor):
    """The door of `tables`. The test sets its lock and its place."""

    vocabulary = DOORS

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.lock = "free"
        self.place = "shut"
        self.drives: list[str] = []

    @classmethod
    def build_lexicon(cls, scene: SceneConfig, plan: Any) -> Lexicon:
        return LEXICON

    def evaluate_conditions(self, tick: int) -> dict[str, str]:
        return {"lock": self.lock, "place": self.place}

    def do_drive(self, speed: str) -> None:
        self.drives.append(speed)


class Bench:
    """A door and its mailboxes, without a bus."""

    def __init__(self, folder: Path) -> None:
        paths = {}
        closed = DOOR.replace('"shut"', '"closed"')
        texts = {
            "normal": f"patience = {PATIENCE_TICKS * TICK_NS / 1e9}\n{DOOR}",
            "careful": closed.replace('place = ["open", "closed"]', 'place = ["open", "shut"]'),
        }
        for name, text in texts.items():
            paths[name] = folder / f"{name}.toml"
            paths[name].write_text(text)
        context = SimpleNamespace(
            board="door",
            scene=None,
            clock_ns=TICK_NS,
            tick_s=TICK_NS * 1e-9,
            params={"tables": {name: str(path) for name, path in paths.items()}},
        )
        self.context = cast(LevelContext, context)
        self.status = TableStatus.zeros({})
        self.last = Reading(TableStatus.zeros({}), Verdict.NONE)
        self.above: Reading | None = None
        self.operator = Reading(OperatorCommand.zeros({}), Verdict.NONE)
        self.door = Door(self.context)
        self.tick = 100

    def command(self, serial: int, words: str, hold: bool = False, operator: int = 0) -> None:
        """Set the command of the level above from now on."""
        message = TableCommand.zeros({})
        message.id, message.words, message.hold, message.operator = serial, words, hold, operator
        self.above = Reading(message, Verdict.NEW)

    def order(self, serial: int, what: Operation, name: str = "") -> Message:
        """Give an operator command, and return the status after the cycle that reads it."""
        message = OperatorCommand.zeros({})
        message.id, message.what, message.name = serial, what, name
        self.operator = Reading(message, Verdict.NEW)
        status = self.cycle()
        self.operator = Reading(message, Verdict.OLD)
        return status

    def cycle(self) -> Message:
        """Run one cycle and return the status."""
        vars(self.door).update(
            above={} if self.above is None else {"task": self.above},
            last_status=self.last,
            operator=self.operator,
            status=self.status,
        )
        self.door.process(self.tick)
        self.tick += 1
        return self.status

    def restart(self) -> None:
        """Restart the board with its last status and every command of the operator."""
        last = TableStatus.zeros({})
        last.copy_from(self.status)
        self.last = Reading(last, Verdict.NEW)
        self.operator = Reading(
            self.operator.message, Verdict.NEW if self.operator.has_message else Verdict.NONE
        )
        self.status = TableStatus.zeros({})
        self.door = Door(self.context)


@pytest.fixture
def bench(tmp_path: Path) -> Bench:
    return Bench(tmp_path)


def brief(status: Message) -> tuple[str, int, str, str, int]:
    """Return state of the table, number and name of the row, command in force and level state."""
    return status.in_state, status.row, status.fired, status.words, State(status.state)


def test_a_command_from_above_is_taken_done_and_answered(bench: Bench) -> None:
    assert brief(bench.cycle()) == ("shut", 3, "stay shut", "", State.IDLE)
    assert bench.status.operator == 0
    bench.command(4, "open")
    status = bench.cycle()
    assert brief(status) == ("moving", 1, "open it", "open", State.EXECUTING)
    assert (status.echo, status.done, status.ordered) == (4, 0, 0)
    assert bench.door.words == ["open"]
    bench.door.place = "open"
    status = bench.cycle()
    assert brief(status) == ("shut", 5, "arrived", "open", State.DONE)
    assert (status.echo, status.done) == (4, 4)
    assert bench.door.drives == ["slowly", "stop"]
    # The command is done. The same serial is not a new command, but the next one is.
    assert bench.cycle().fired == "stay shut"
    bench.command(5, "open")
    status = bench.cycle()
    assert (status.fired, status.echo, status.done) == ("open it", 5, 4)


def test_a_command_that_no_row_takes_is_not_in_force(bench: Bench) -> None:
    bench.door.lock = "locked"
    bench.command(1, "open")
    status = bench.cycle()
    assert brief(status) == ("shut", 2, "locked", "", State.HOLDING)
    assert (status.reason, status.echo) == ("locked", 0)
    # A reason from below is appended to a row's reason.
    bench.door.detail = "no key"
    assert bench.cycle().reason == "locked: no key"
    bench.door.lock = "free"
    bench.command(2, "paint blue")
    # The table has no row for words that the level does not know.
    assert brief(bench.cycle()) == ("shut", 3, "stay shut", "", State.IDLE)


@pytest.mark.parametrize("place", ["between", "open"])
def test_a_state_is_late_after_more_than_its_patience(bench: Bench, place: str) -> None:
    bench.command(1, "open")
    bench.cycle()
    bench.door.place = "between"
    assert [bench.cycle().fired for _ in range(PATIENCE_TICKS)] == ["moves"] * PATIENCE_TICKS
    bench.door.place = place
    status = bench.cycle()
    if place == "open":
        assert (status.fired, status.error, status.reason) == ("arrived", Error.NONE, "")
    else:
        assert (status.fired, status.error, status.reason) == ("jams", Error.TABLE, "the door jams")
        assert status.done == 0


def test_the_level_above_holds_this_one_while_it_executes(bench: Bench) -> None:
    bench.command(1, "open", hold=True, operator=9)
    status = bench.cycle()
    assert (status.state, bench.door.is_held, status.operator) == (State.HOLDING, True, 9)
    assert "above" in status.reason
    bench.command(1, "open", operator=9)
    bench.door.place = "between"
    assert (bench.cycle().state, bench.door.is_held) == (State.EXECUTING, False)
    assert bench.above is not None
    bench.above = bench.above._replace(is_lost=True)
    assert (bench.cycle().state, bench.door.is_held) == (State.HOLDING, True)


def test_an_operators_hold_is_done_when_all_is_at_rest(bench: Bench) -> None:
    bench.command(1, "open")
    bench.cycle()
    bench.door.place = "between"
    bench.door.resting = False
    status = bench.order(1, Operation.HOLD)
    assert (status.state, status.answer, status.order) == (State.HOLDING, Answer.TAKEN, 1)
    bench.door.resting = True
    assert bench.cycle().answer == Answer.DONE
    bench.order(2, Operation.RESUME)
    assert (bench.cycle().state, bench.door.is_held) == (State.EXECUTING, False)
    # A case that no row takes is an error with the case.
    bench.door.place = "nowhere"
    status = bench.cycle()
    assert (status.row, status.fired, status.error) == (0, "", Error.TABLE)
    assert status.reason.startswith("no row of 'moving' takes lock = free, place = nowhere")


def test_an_operators_command_takes_precedence_over_the_level_above(bench: Bench) -> None:
    bench.command(7, "paint red")
    status = bench.order(3, Operation.DO, "open")
    assert brief(status) == ("moving", 1, "open it", "open", State.EXECUTING)
    assert (status.ordered, status.echo, status.answer) == (3, 0, Answer.TAKEN)
    bench.door.place = "open"
    status = bench.cycle()
    assert (status.state, status.answer, status.done) == (State.DONE, Answer.DONE, 0)
    # After its release the level continues with the command from above.
    bench.order(4, Operation.RESUME)
    assert bench.cycle().echo == 0
    assert not bench.door.is_held


def test_a_refusal_names_the_invalid_word_and_the_valid_tables(bench: Bench) -> None:
    status = bench.order(1, Operation.DO, "paint blue")
    assert (status.answer, status.standing, status.words) == (Answer.REFUSED, Operation.NONE, "")
    assert "blue" in status.objection
    status = bench.order(2, Operation.TABLE, "other")
    assert status.answer == Answer.REFUSED
    assert status.objection == "no table 'other'; tables: normal, careful"
    assert status.table == "normal"


def test_a_restarted_board_continues_from_its_last_status(bench: Bench) -> None:
    bench.order(1, Operation.TABLE, "careful")
    bench.order(2, Operation.TABLE, "normal")
    bench.command(6, "open")
    bench.cycle()
    bench.restart()
    bench.door.place = "between"
    status = bench.cycle()
    assert brief(status) == ("moving", 4, "moves", "open", State.EXECUTING)
    assert (status.table, status.echo, bench.door.drives) == ("normal", 6, [])
    bench.door.place = "open"
    assert bench.cycle().done == 6
    bench.restart()
    assert (bench.cycle().fired, bench.status.done) == ("stay shut", 6)
    # It also continues with an operator's command.
    bench.door.place = "shut"
    bench.order(3, Operation.DO, "open")
    bench.restart()
    bench.door.place = "between"
    status = bench.cycle()
    assert (status.fired, status.ordered, status.words) == ("moves", 3, "open")


@pytest.mark.parametrize(
    ("state", "echo", "serial", "expected"),
    [
        (State.DONE, 3, 3, "done"),
        (State.ERROR, 3, 3, "error"),
        (State.EXECUTING, 3, 3, "executing"),
        (State.HOLDING, 3, 3, "executing"),
        (State.DONE, 2, 3, "waiting"),
        (State.DONE, 4, 3, "waiting"),
        (State.DONE, 0, 0, "waiting"),
    ],
)
def test_the_level_below_has_answered_when_it_echoes_the_newest_command(
    state: State, echo: int, serial: int, expected: str
) -> None:
    status = TableStatus.zeros({})
    status.state, status.echo = state, echo
    assert classify_answer(Reading(status, Verdict.OLD), serial) == expected
    assert classify_answer(Reading(status, Verdict.NONE), serial) == "waiting"
    assert classify_answer(Reading(status, Verdict.OLD, is_lost=True), serial) == "lost"
