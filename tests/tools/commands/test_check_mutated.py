"""Tests `rack check` with mutated configs: it always ends in time with exit status 0, 1 or 2.

Status 1 means only that the config is valid and its timing does not fit. Any other problem is a
mistake, reported in one line.
"""

from __future__ import annotations

import copy
import json
import os
import random
import signal
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from rack.boards.config import CONFIGS, list_names, load
from rack.boards.config.toml import to_toml
from rack.tools.console.answer import MAX_LINE
from tests.tools.command_line import rack

pytestmark = pytest.mark.thorough

EXAMPLES, FIRST = 150, int(os.environ.get("RACK_CHECK_SEED", "1"))
"""How many configs are examined, and the seed of the first."""
BOUND_S = 20
"""Processor time of one check, at most: the machine's load does not count."""

DEEP: list[Any] = []
for _ in range(40):
    DEEP = [DEEP]
NUMBERS = (True, False, 0, 1, -1, 3, 99, 2**31, 2**63 - 1, 2**70, 0.0, 0.5, 2.5, 1e-9, 1e9)
EXTREME = (5e-324, 1e300, -1e300, float("inf"), float("-inf"), float("nan"))
TEXTS = ("", "lock", "servo", "x" * 5000, "two\nlines", "a\0b", "../..", "~no/x")
LISTS = ([], [1], [1.0] * 6, ["a"], [[]], [0] * 1000, {}, {"a": 1}, {"": {}}, {"every": 8}, DEEP)
VALUES = (*NUMBERS, *EXTREME, *TEXTS, *LISTS)
KEYS = ("", "x", "every", "rate_hz", "below", "planner", "params", "a.b", "k" * 300, "model")
PIECES = ("=", "[", "]]", '"', "1990-03-01", "0x", "\x7f", "\ufeff", "#", "\t", "nan", "1e400")


@cache
def texts() -> dict[str, dict[str, Any]]:
    """Every shipped config, as written and resolved. Partial configs extend a complete one."""
    found = {
        str(path.relative_to(CONFIGS)): tomllib.loads(path.read_text())
        for path in sorted(CONFIGS.rglob("*.toml"))
    }
    for place, tables in found.items():
        if "model" in tables.get("robot", {}):
            tables["robot"]["model"] = f"robots/{tables['robot']['model']}"
        if "/" in place:
            tables["extends"] = ["nasrem"]
    return found | {
        f"{name}, resolved": tomllib.loads(load(name).to_toml_text()) for name in list_names()
    }


def places(node: Any) -> Iterator[tuple[Any, Any]]:
    """Yield every value with its container and its key or index."""
    keys = list(node) if isinstance(node, dict) else range(len(node))
    for key in keys:
        yield node, key
        if isinstance(node[key], dict | list):
            yield from places(node[key])


def spoil(tables: dict[str, Any], draw: random.Random) -> None:
    """Make one change that a user, or an attacker, might make."""
    found = [*places(tables)]
    holder, key = draw.choice(found)
    other, name = draw.choice(found)
    change = draw.choice(("replace", "swap", "delete", "rename", "add", "double"))
    if change == "delete":
        del holder[key]
    elif change == "swap":
        holder[key] = copy.deepcopy(other[name])
    elif isinstance(holder, list) or change == "replace":
        holder[key] = copy.deepcopy(draw.choice(VALUES))
    elif change == "rename":
        holder[draw.choice(KEYS)] = holder.pop(key)
    elif change == "add":
        holder[draw.choice(KEYS)] = copy.deepcopy(draw.choice(VALUES))
    else:
        holder[f"{key}2"] = copy.deepcopy(holder[key])


def torn(text: str, draw: random.Random) -> str:
    """Return a text after careless editing: a line doubled, removed, cut off or inserted."""
    lines = text.splitlines()
    at = draw.randrange(len(lines))
    line, rest, piece = lines[at], lines[at + 1 :], draw.choice(PIECES)
    column = draw.randint(0, len(line))
    stray = line[:column] + piece + line[column:]
    assigned = f"{line.partition('=')[0]}= {piece}"
    ends = ([line, line, *rest], rest, [], [stray, *rest], [assigned, *rest])
    return "\n".join([*lines[:at], *draw.choice(ends)])


def spoilt(draw: random.Random) -> str:
    """Return the text of a config with one to three random changes."""
    tables = copy.deepcopy(texts()[draw.choice(sorted(texts()))])
    for _ in range(draw.randint(1, 3)):
        if tables:
            spoil(tables, draw)
    text = to_toml(tables)
    return torn(text, draw) if text and draw.random() < 0.15 else text


@contextmanager
def bounded() -> Iterator[None]:
    """Limit the processor time of the body."""

    def end(signum: int, frame: object) -> None:
        raise TimeoutError(f"more than {BOUND_S} s of processor time")

    before = signal.signal(signal.SIGPROF, end)
    signal.setitimer(signal.ITIMER_PROF, BOUND_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def check(*arguments: str) -> tuple[int, dict[str, Any]]:
    """Run `rack check --json` in a bounded time, and return its exit status and answer."""
    with bounded():
        done = rack("check", *arguments, "--json")
    return done.returncode, json.loads(done.stdout, parse_constant=pytest.fail)


def judge(status: int, document: dict[str, Any]) -> None:
    if status == 2:
        lines = document["error"]
        assert lines
        assert all(line and line.isprintable() and len(line) <= MAX_LINE for line in lines)
    else:
        assert status == (0 if document["timing"]["holds"] else 1)


@pytest.mark.timeout(600)  # a machine that is shared: the bound is processor time
def test_a_mutated_config_gets_an_answer_in_time(tmp_path: Path) -> None:
    path, seen = tmp_path / "spoilt.toml", set()
    for seed in range(FIRST, FIRST + EXAMPLES):
        path.write_text(spoilt(random.Random(seed)))
        status, document = check(str(path))
        judge(status, document)
        seen.add(status)
    assert {0, 2} <= seen, "few of the configs do not fit: 1 is rare"


ATTACKS = {
    "circle": ("nasrem", 'board.servo.below="primitive"', "board.servo.below"),
    "no clock": ("nasrem", "clock.period_ms=1e-6", "clock.period_ms"),
    "no cycle": ("fig2", "board.level.every=1000000000000", "board.level.every"),
    "much too fast": ("fig2", "clock.speed=1e300", "clock.speed"),
    "much too slow": ("fig2", "clock.speed=1e-300", "clock.speed"),
    "truth": ("fig2", "clock.period_ms=true", "clock.period_ms"),
    "text": ("fig2", 'board.level.params.process_ms="lock"', "board.level.params.process_ms"),
    "unknown": ("fig2", "board.level.params.proces_ms=1", "board.level.params.proces_ms"),
    "deep": ("fig2", f"task.x={'[' * 1000}{']' * 1000}", "--set"),
    "deep keys": ("fig2", f"task{'.a' * 1000}=1", "--set"),
    "digits": ("fig2", f"seed={'9' * 4000}", "--set"),
}


@pytest.mark.parametrize(("name", "setting", "place"), ATTACKS.values(), ids=ATTACKS)
def test_configs_that_once_hung_or_crashed_the_check_are_mistakes(
    name: str, setting: str, place: str
) -> None:
    status, document = check(name, "--set", setting)
    judge(status, document)
    assert [line.startswith(f"{place} ") for line in document["error"]] == [True]


def test_the_longest_possible_cycles_and_plans_are_judged_in_time() -> None:
    settings = (
        *("clock.period_ms=0.01", "timing.clock_ms=0.009999", "board.level.every=1000000"),
        *("board.level.core=0", "board.level.within_cycles=10000"),
        "board.level.budget.process_ms=0.5",
    )
    status, document = check("fig2", *(f"--set={setting}" for setting in settings))
    assert (status, document["timing"]["holds"]) == (1, False)
