"""Mistakes of every stage of validation are reported at once: of files, settings, single tables,
classes, wiring, rules, params, faults and commands. None of them causes another one."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import combinations
from pathlib import Path

import pytest

from rack.boards.config import load, resolve
from rack.boards.errors import ConfigError

Write = Callable[[str, str], Path]
FIGURE = 'executor = "rack.levels.systems.figures:FigureLoop"'


def board(name: str, slot: int, rest: str) -> str:
    return f"[board.{name}]\nslot = {slot}\n{rest}\n"


STAGES = {
    "timing.small_share": "[timing]\nsmall_share = 2\n",
    "board.one.slot": board("one", 99, f"every = 1\n{FIGURE}"),
    "board.two.executor": board("two", 5, 'every = 1\nexecutor = "nowhere:Nothing"'),
    "board.three.reads.nothing": board(
        "three", 6, f'every = 1\n{FIGURE}\nreads = {{ nothing = "lower.status" }}'
    ),
    "board.four.rate_hz": board("four", 7, f"rate_hz = 333\n{FIGURE}"),
    "board.five.params.nothing": board("five", 8, f"every = 1\n{FIGURE}\nparams.nothing = 1"),
    "board.six.above": board("six", 9, f'every = 1\n{FIGURE}\nabove = "nobody"'),
    "protocol.strict_": "[protocol]\nstrict_ = true\n",
    "record": '[record]\nbefore = "1s"\n',
    "fault.kind": '[[fault]]\nkind = "bogus"\nboard = "lower"\n',
    "fault.mailbox": '[[fault]]\nkind = "drop"\nboard = "lower"\nmailbox = "upper.command"\n',
    "fault.when": '[[fault]]\nkind = "kill"\nboard = "lower"\nwhen = "lower.status.gone == 1"\n',
    "fault.board": '[[fault]]\nkind = "kill"\nboard = "nobody"\n',
    "command.level": '[[command]]\nlevel = "lower"\nwhat = "hold"\n',
}
"""Parts of a config with one mistake each, by the place of the mistake."""
NEED_PROTOCOL = {"fault.mailbox", "fault.when"}
"""Mistakes that show only in a layout, and thus not while the protocols are unknown."""


def mistakes(
    small: Path, write: Write, parts: Sequence[str], settings: Sequence[str], faults: str | None
) -> list[str]:
    text = 'extends = ["small.toml"]\n' + "".join(STAGES[part] for part in parts)
    with pytest.raises(ConfigError) as error:
        resolve(load(write("mine.toml", text), settings, faults))
    return sorted(
        mistake.place.replace("[0]", "").replace("[1]", "").replace("[2]", "").replace("[3]", "")
        for mistake in error.value.mistakes
    )


def expected(parts: Sequence[str]) -> list[str]:
    hidden = NEED_PROTOCOL if "protocol.strict_" in parts else set[str]()
    return sorted(part for part in parts if part not in hidden)


@pytest.mark.parametrize("part", STAGES)
def test_two_mistakes_of_any_stages_are_two_lines(small: Path, write: Write, part: str) -> None:
    for pair in combinations(STAGES, 2):
        if part == pair[0]:
            assert mistakes(small, write, pair, (), None) == expected(pair), pair


def test_mistakes_of_all_stages_come_at_once(small: Path, write: Write) -> None:
    parts = [part for part in STAGES if part != "protocol.strict_"]
    found = mistakes(small, write, parts, ("seed", "supervision.restarts=-1"), "nowhere")
    assert found == sorted([*parts, "--set", "--faults", "supervision.restarts"])


def test_an_invalid_setting_does_not_report_missing_keys(small: Path, write: Write) -> None:
    alone = write("alone.toml", '[board.lower]\nslot = 2\nexecutor = "nowhere:Nothing"\n')
    with pytest.raises(ConfigError) as error:
        load(alone, ["name=alone", "clock.period_ms", "board.lower.every"])
    assert [mistake.place for mistake in error.value.mistakes] == ["--set", "--set"]


def test_files_that_cannot_be_read_do_not_hide_other_mistakes(write: Write) -> None:
    write("broken.toml", "name = \n")
    text = 'extends = ["gone.toml", "broken.toml"]\nname = "Loud"\n[clock]\nsped = 1\n'
    with pytest.raises(ConfigError) as error:
        load(write("mine.toml", text), ["seed"], "nowhere")
    assert [mistake.place for mistake in error.value.mistakes] == [
        "mine.toml: extends",
        "broken.toml",
        "--faults",
        "--set",
        "name",
        "clock.sped",
    ]


def test_a_model_that_cannot_be_read_does_not_hide_other_mistakes(write: Write) -> None:
    text = 'extends = ["nasrem"]\n[robot]\nmodel = "gone.xml"\nvelocity = [1.0]\n'
    text += "acceleration = [1.0]\njerk = [1.0]\n[board.servo]\nrate_hz = 333\n"
    text += STAGES["fault.kind"].replace("lower", "servo")
    with pytest.raises(ConfigError) as error:
        resolve(load(write("mine.toml", text), ["seed"]))
    places = [mistake.place for mistake in error.value.mistakes]
    assert places == ["--set", "robot", "board.servo.rate_hz", "fault[0].kind"]
