"""Campaigns on a board without and with a standby: what is struck, measured and said."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.backplane.mailbox.protocols import open_standby_writer, open_writer
from rack.boards.config import load, resolve_layout
from rack.boards.events import Event
from rack.tools.faults.campaigns.comparison import list_standby_settings, remove_standby
from rack.tools.faults.campaigns.outages import count_missing_messages, list_outages
from rack.tools.faults.campaigns.plan import Plan, strike_active_copies
from rack.tools.faults.ending import Strike
from rack.tools.faults.evidence import BRAKES, SKIPPED
from tests.backplane.bus import NAME, mailbox
from tests.backplane.conftest import MakeBus, make_bus  # noqa: F401  a fixture
from tests.tools.command_line import rack, read_answer, read_refusal

STANDBY = "board.lower.standby={slot=9,core=0}"


def test_a_board_without_a_standby_gets_one_and_loses_it_again(small: Path) -> None:
    config = load(small)
    (setting,) = list_standby_settings(config, "lower")
    assert setting.startswith("board.lower.standby={slot=21,core=")
    both = load(small, [setting])
    assert list_standby_settings(both, "lower") == ()
    assert remove_standby(both, "lower") == config


def test_faults_strike_the_copies_in_turn(small: Path) -> None:
    layout = resolve_layout(load(small, [STANDBY]))
    faults = tuple({"kind": "kill", "board": "lower", "tick": tick} for tick in (1, 2, 3))
    (plan,) = strike_active_copies([Plan(1, "faults", True, faults)], layout, "lower")
    assert [fault["board"] for fault in plan.faults] == ["lower", "lower.standby", "lower"]
    assert [fault["tick"] for fault in plan.faults] == [1, 2, 3]


def test_an_outage_ends_when_a_copy_takes_over_or_the_board_is_back(small: Path) -> None:
    layout = resolve_layout(load(small, [STANDBY]))
    events = [
        Event(0, 12, "recovery", "upper", "", code="rejoined"),
        Event(0, 15, "recovery", "lower.standby", "", code="taken_over"),
        Event(0, 16, "reaction", "upper", "", code=BRAKES),
        Event(0, 90, "recovery", "lower", "", code="rejoined"),
        Event(0, 93, "reaction", "lower", "", code=BRAKES),
    ]
    strikes = [
        Strike(number, kind, board, tick, tick + 1, tick)
        for number, (kind, board, tick) in enumerate(
            [
                ("kill", "lower", 10),
                ("kill", "lower", 20),
                ("kill", "lower", 95),
                ("mute", "lower", 11),
                ("kill", "lower", -1),
            ]
        )
    ]
    assert [*list_outages(strikes, events, layout)] == [(5, True), (70, False)]


def test_missing_messages_are_counted_up_to_the_newest(
    make_bus: MakeBus,  # noqa: F811
) -> None:
    segment = make_bus(mailbox(every=2, delay=2))
    writer = open_writer(segment, NAME)
    for tick in (0, 2, 8):
        writer.write(tick)
    skipped = [Event(0, 7, "miss", name, "", code=SKIPPED, value=2, since=5) for name in "ab"]
    assert count_missing_messages(segment, {"writer"}, ()) == 2
    assert count_missing_messages(segment, {"writer"}, skipped) == 1
    assert count_missing_messages(segment, {"reader"}, ()) == 0
    standby = open_standby_writer(segment, NAME)
    standby.take_over()
    standby.write(10)
    assert count_missing_messages(segment, {"writer"}, ()) == 2
    for _ in range(3):
        standby.write(10)
    assert count_missing_messages(segment, {"writer"}, ()) == 0


@pytest.mark.thorough
def test_the_command_compares_kills_without_and_with_a_standby(small: Path, tmp_path: Path) -> None:
    out = tmp_path / "campaign"
    options = ("--kinds", "kill", "--lockstep", "--injections", 3, "--seconds", 9, "--out", out)
    report = read_answer("campaign", small, "--standby", "lower", *options)
    assert report["shortfalls"] == []
    without, with_standby = report["comparison"]
    assert (without["faults"], with_standby["faults"]) == (3, 3)
    assert without["max_ticks"] > 0
    assert without["missed"] > 0
    assert (with_standby["max_ticks"], with_standby["missed"]) == (0, 0)
    assert "with standby" in (out / "comparison.md").read_text()


@pytest.mark.parametrize(
    ("options", "line"),
    [
        (("--standby", "low"), "--standby low: there is no such board; boards: upper, lower"),
        (("--standby", "lower", "--kills", 3), "--kills 3 and --standby lower exclude each other"),
    ],
)
def test_a_mistaken_comparison_is_refused(
    small: Path, options: tuple[object, ...], line: str
) -> None:
    assert line in read_refusal(rack("campaign", small, *options))
