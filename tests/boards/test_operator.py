"""Commands of an operator on real boards: given at their ticks by the clock, answered, logged,
repeated bit for bit."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest

from rack.backplane.mailbox.history import MailboxRing
from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.operator_table import OperatorTable, Request, RequestStage
from rack.backplane.words import System
from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.events import Event, Outcome
from rack.boards.operator import copy_request_message
from rack.levels.operator import Answer, Goal, Operation
from tests.boards.commanded_racks import COMMANDED, commands
from tests.boards.config.mistakes import find_mistake
from tests.boards.conftest import MakeConfig
from tests.boards.runs import faulty, stop, watch_until
from tests.boards.runs import kill as kill_at
from tests.processes import FORKS, forked, kill, wait_until

pytestmark = pytest.mark.slow
HELD = commands("level='upper', what='hold', tick=101", "level='upper', what='resume', tick=203")
UPPER, LOWER = 8, 1
SECONDS = 1.0


@pytest.fixture
def commanded(config: MakeConfig) -> Callable[..., RackConfig]:
    return lambda *settings: config(*settings, text=COMMANDED)


def run(
    config: RackConfig, seconds: float = SECONDS
) -> tuple[Outcome, list[Event], dict[str, np.ndarray]]:
    """Run a rack; return how it ended, what happened, and what the mailboxes hold, by name."""
    with Rack(config) as rack:
        boxes = [box.name for box in rack.segment.layout.mailboxes]
        outcome = rack.run(seconds)
        return (
            outcome,
            rack.events,
            {name: MailboxRing(rack.segment, name).read_new_rows().rows for name in boxes},
        )


def first(rows: np.ndarray, serial: int) -> int:
    """Return the tick of the first status that rests on a command."""
    return int(rows["tick"][np.argmax(rows["message"]["operator"] >= serial)])


def test_a_command_is_issued_at_its_tick_and_passed_down_level_by_level(
    commanded: Callable[..., RackConfig],
) -> None:
    _, events, boxes = run(commanded(HELD))
    given = boxes["upper.operator"]
    assert given["tick"].tolist() == [101, 203]
    assert given["visible_at"].tolist() == [102, 204]
    assert given["message"]["id"].tolist() == [1, 2]
    # Read at the next release of the upper level, 104 and 208, and visible below when that cycle is
    # over.
    assert [first(boxes["upper.status"], serial) for serial in (1, 2)] == [104, 208]
    assert [first(boxes["lower.status"], serial) for serial in (1, 2)] == [112, 216]
    counts = dict(
        zip(
            boxes["lower.status"]["tick"].tolist(),
            boxes["lower.status"]["message"]["count"],
            strict=True,
        )
    )
    assert counts[111] == counts[110] + 1
    assert counts[112] == counts[111] == counts[215]
    assert counts[216] == counts[215] + 1
    seen = [event for event in events if event.kind == "command"]
    assert [(e.tick, e.code, e.board, e.subject, e.value) for e in seen] == [
        (101, "hold", "upper", "upper", 1),
        (203, "resume", "upper", "upper", 2),
    ]


SET = commands(
    "level='lower', what='set', name='by=3', tick=101",
    "level='lower', what='set', name='by=2', tick=200",
)
BY_ITSELF, BY_ITS_BOARD = "Lower", "Plain"
set_either_way = pytest.mark.parametrize("level", [BY_ITSELF, BY_ITS_BOARD])
"""Whether a level takes the operator's commands itself, or leaves live parameters to its board."""


@set_either_way
def test_a_live_parameter_is_set_between_two_cycles_and_its_event_has_both_values(
    commanded: Callable[..., RackConfig], level: str
) -> None:
    lower = f"board.lower.executor=commanded_levels:{level}"
    runs = [run(commanded(setting, lower)) for setting in (SET, SET, "seed=0")]
    assert runs[0][0].digest == runs[1][0].digest != runs[2][0].digest
    _, events, boxes = runs[0]
    rows = boxes["lower.status"]
    steps = dict(zip(rows["tick"][1:].tolist(), np.diff(rows["message"]["count"]), strict=True))
    assert [steps[tick] for tick in (101, 102, 200, 201)] == [1, 3, 3, 2]
    answered = dict(zip(rows["tick"].tolist(), rows["message"]["order"].tolist(), strict=True))
    assert [answered[tick] for tick in (101, 102, 200, 201)] == [0, 1, 1, 2]
    seen = [event for event in events if event.kind == "command"]
    assert [(e.tick, e.code, e.board, e.text) for e in seen] == [
        (101, "set", "lower", "set by=3 (command 1)"),
        (200, "set", "lower", "set by=2 (command 2)"),
    ]


@set_either_way
def test_a_restarted_board_has_its_live_params_as_they_were_set(
    commanded: Callable[..., RackConfig], level: str
) -> None:
    lower = f"board.lower.executor=commanded_levels:{level}"
    outcome, events, boxes = run(faulty(commanded(SET, lower), kill_at("lower", 250)), 2.0)
    assert outcome.is_success
    assert [event.board for event in events if event.code == "rejoined"] == ["lower"]
    assert np.diff(boxes["lower.status"]["message"]["count"])[-50:].tolist() == [2] * 50


@pytest.mark.parametrize(
    ("table", "line"),
    {
        "level='lower', what='set', name='by=0'": "command[0].name.by = 0: should be greater than"
        " or equal to 1; counts in a cycle",
        "level='lower', what='set', name='label=1'": "command[0].name.label = 1: not a live"
        " parameter; live parameters: by",
        "level='lower', what='set'": "command[0].name: must be key=value, as in bandwidth=80",
        "level='upper', what='set', name='by=1'": "command[0].what = \"set\": 'upper' does not take"
        " set; it takes: hold, resume, goto home",
    }.items(),
)
def test_an_impossible_setting_is_refused_in_one_line(table: str, line: str) -> None:
    assert find_mistake(COMMANDED, commands(table)) == line


def test_a_refused_command_is_answered_and_not_passed_down(
    commanded: Callable[..., RackConfig],
) -> None:
    _, _, boxes = run(commanded(commands("level='upper', what='goto', home=true, tick=50")))
    last = boxes["upper.status"]["message"][-1]
    assert (last["order"], last["answer"], last["standing"]) == (1, Answer.REFUSED, Operation.NONE)
    assert last["objection"] == b"the way home is closed"
    assert not boxes["lower.status"]["message"]["operator"].any()


@pytest.mark.parametrize("board", ["upper", "lower"])
def test_a_restarted_board_keeps_the_command_before_a_refused_one(
    commanded: Callable[..., RackConfig], board: str
) -> None:
    # The lower level never takes a goto: its config would refuse it, an intruder in the table may
    # say it all the same.
    config = commanded(commands(f"level='{board}', what='hold', tick=50"))
    with Rack(faulty(config, kill_at(board, 100))) as rack:
        hold = OperatorTable(rack.segment).entries[0]
        message = copy_request_message(hold, rack.segment.layout)
        message.what, message.goal = Operation.GOTO, Goal.HOME
        OperatorTable(rack.segment).add_request(Request(hold.mailbox, bytes(message.raw), 60))
        assert rack.run(1.0).is_success
        last = MailboxRing(rack.segment, f"{board}.status").read_new_rows().rows["message"][-1]
    assert [event.board for event in rack.events if event.code == "rejoined"] == [board]
    assert (last["order"], last["answer"], last["standing"], last["operator"]) == (
        2,
        Answer.REFUSED,
        Operation.HOLD,
        1,
    )


def test_a_program_commands_its_rack_during_the_run(commanded: Callable[..., RackConfig]) -> None:
    with Rack(commanded("clock.mode=realtime")) as rack:
        rack.start(20.0)
        entry = rack.command("lower", "hold")
        watch_until(rack, lambda: entry.stage == RequestStage.GIVEN)
        status = open_observer(rack.segment, "lower.status")
        watch_until(
            rack,
            lambda: (
                (reading := status.peek()).has_message and reading.message.order == entry.serial
            ),
        )
        later = rack.segment.words[System.TICK] + 40
        second = rack.command("lower", "resume", tick=later)
        watch_until(rack, lambda: second.stage == RequestStage.GIVEN)
        assert second.given_tick >= later
        assert stop(rack).cause == "stopped"


@pytest.mark.filterwarnings(FORKS)
@pytest.mark.parametrize("is_killed", [False, True])
def test_a_command_is_issued_only_while_its_client_lives(
    commanded: Callable[..., RackConfig], is_killed: bool
) -> None:
    with Rack(commanded(commands("level='upper', what='hold', tick=50"))) as rack:
        table = OperatorTable(rack.segment)
        wanted = Request(table.entries[0].mailbox, bytes(table.entries[0].message), 100)

        def wait() -> None:
            with OperatorTable(rack.segment).claim_request(wanted):
                time.sleep(60)

        with forked(wait) as pid:
            wait_until(lambda: len(table.list_waiting()) == 2)
            if is_killed:
                kill(pid)
            assert rack.run(1.0).is_success
        assert (
            MailboxRing(rack.segment, "upper.operator").read_new_rows().rows["tick"].tolist()
            == [50, 100][: 2 - is_killed]
        )
