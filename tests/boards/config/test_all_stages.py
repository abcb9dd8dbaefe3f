"""Mistakes of every stage of validation are reported at once: of files, settings, single tables,
classes, wiring, rules, params, faults and commands. None of them causes another one."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path

import pytest

from tests.boards.config.mistakes import find_mistake, find_mistakes
from tests.boards.conftest import format_board

Write = Callable[[str, str], Path]
FIGURE = "rack.levels.systems.figures:FigureLoop"
STAGES = {
    "timing.small_share": "[timing]\nsmall_share = 2\n",
    "board.one.slot": format_board("one", 99, FIGURE, every=1),
    "board.two.executor": format_board("two", 5, "nowhere:Nothing", every=1),
    "board.three.reads.nothing": format_board(
        "three", 6, FIGURE, every=1, reads={"nothing": "lower.status"}
    ),
    "board.four.rate_hz": format_board("four", 7, FIGURE, rate_hz=333),
    "board.five.params.nothing": format_board("five", 8, FIGURE, every=1, params={"nothing": 1}),
    "board.six.above": format_board("six", 9, FIGURE, every=1, above="nobody"),
    "protocol.strict_": "[protocol]\nstrict_ = true\n",
    "record": '[record]\nbefore = "1s"\n',
    "fault.kind": '[[fault]]\nkind = "bogus"\nboard = "lower"\n',
    "fault.mailbox": '[[fault]]\nkind = "drop"\nboard = "lower"\nmailbox = "upper.command"\n',
    "fault.when": '[[fault]]\nkind = "kill"\nboard = "lower"\nwhen = "lower.status.gone == 1"\n',
    "fault.board": '[[fault]]\nkind = "kill"\nboard = "nobody"\n',
    "command.level": '[[command]]\nlevel = "lower"\nwhat = "hold"\n',
}
"""Parts of a config with one mistake each, by the place of the mistake."""


def places(config: Path, *settings: str, faults: str | None = None) -> list[str]:
    """Return the places of all mistakes, without numbers of list entries."""
    found = find_mistakes(config, *settings, faults=faults)
    return [re.sub(r"\[\d\]", "", mistake.place) for mistake in found]


def assembled(write: Write, parts: Sequence[str]) -> Path:
    text = "".join(STAGES[part] for part in parts)
    return write("mine.toml", f'extends = ["small.toml"]\n{text}')


@pytest.mark.usefixtures("small")
@pytest.mark.parametrize("part", STAGES)
def test_two_mistakes_of_any_stages_are_two_lines(write: Write, part: str) -> None:
    for pair in combinations(STAGES, 2):
        if part == pair[0]:
            # Without protocols there is no layout to check these against.
            hidden = {"fault.mailbox", "fault.when"} if "protocol.strict_" in pair else set()
            assert sorted(places(assembled(write, pair))) == sorted({*pair} - hidden), pair


@pytest.mark.usefixtures("small")
def test_mistakes_of_all_stages_come_at_once(write: Write) -> None:
    parts = [part for part in STAGES if part != "protocol.strict_"]
    mine = assembled(write, parts)
    found = places(mine, "seed", "supervision.restarts=-1", faults="nowhere")
    assert sorted(found) == sorted([*parts, "--set", "--faults", "supervision.restarts"])


def test_an_invalid_setting_does_not_report_missing_keys(write: Write) -> None:
    alone = write("alone.toml", '[board.lower]\nslot = 2\nexecutor = "nowhere:Nothing"\n')
    found = places(alone, "name=alone", "clock.period_ms", "board.lower.every")
    assert found == ["--set", "--set"]


def test_files_that_cannot_be_read_do_not_hide_other_mistakes(write: Write) -> None:
    write("broken.toml", "name = \n")
    text = 'extends = ["gone.toml", "broken.toml"]\nname = "Loud"\n[clock]\nsped = 1\n'
    found = places(write("mine.toml", text), "seed", faults="nowhere")
    unread = ["mine.toml: extends", "broken.toml", "--faults", "--set"]
    assert found == [*unread, "name", "clock.sped"]


def test_a_model_that_cannot_be_read_does_not_hide_other_mistakes(write: Write) -> None:
    text = 'extends = ["nasrem"]\n[robot]\nmodel = "gone.xml"\nvelocity = [1.0]\n'
    text += "acceleration = [1.0]\njerk = [1.0]\n[board.servo]\nrate_hz = 333\n"
    text += STAGES["fault.kind"].replace("lower", "servo")
    found = places(write("mine.toml", text), "seed")
    assert found == ["--set", "robot", "board.servo.rate_hz", "fault.kind"]


def test_a_board_whose_name_contains_a_dot_and_whose_keys_are_wrong_is_left_out() -> None:
    text = """
        format = 2
        name = "dotted"
        [clock]
        period_ms = 2.5
        [board."a.b"]
        slot = 3
        every = 1
        executor = "rack.levels.servo:ServoExecutor"
        above = [1e300]
        """
    assert "board.a.b.above[0] = 1e+300: should be a valid string" in find_mistake(text)
