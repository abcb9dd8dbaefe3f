"""Mistakes of faults: all of them at once, each with its place, its value and what is valid."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import pytest

from rack.backplane.address_map import FAULT_ENTRIES
from rack.backplane.layout import Layout
from rack.boards.config import load_text, resolve, resolve_layout
from rack.boards.config.injections import find_fault_mistakes
from rack.boards.config.published import Levels, gather_facts
from rack.boards.config.schema import RackConfig
from rack.boards.faults.config import FaultConfig
from rack.boards.faults.kind import KINDS, Kind, Parameter
from tests.boards.config.mistakes import find_mistake, find_mistakes, read_config
from tests.boards.fault_racks import DRIVEN, LOCKED, TARGETS, inline

Fault = dict[str, Any]
WHEN = {"kind": "kill", "board": "wave"}
MISTAKES: list[tuple[Fault, str]] = [
    ({"kind": "kil", "board": "wave"}, f'"kil": no such kind; kinds: {", ".join(KINDS.names)}'),
    (
        {"kind": "kill", "board": "wve"},
        '.board = "wve": no such task; tasks: wave, wave.planner, watch, driven, clock',
    ),
    (
        {"kind": "kill", "board": "wave", "tick": 1, "at": 1.0},
        ".at = 1.0: tick is also given; give only one of tick, at, when",
    ),
    ({"kind": "mute", "board": "wave", "for": "1 hour"}, 'should be a time, as in "0.5s", "20ms"'),
    ({"kind": "drop", "board": "wave", "probability": float("nan")}, "a finite number"),
    (
        {"kind": "mute", "board": "watch", "mailbox": "wave.status"},
        ".mailbox = \"wave.status\": 'watch' does not write it; it writes: watch.status",
    ),
    (
        {"kind": "overrun", "board": "wave.planner"},
        "overrun strikes only executors; executors: wave, watch, driven",
    ),
    (
        {"kind": "sensor-nan", "board": "wave"},
        "sensor-nan cannot strike this board; boards that it can: driven",
    ),
    ({"kind": "clock-skip", "board": "wave"}, 'strikes only the clock; must be "clock"'),
    (
        {"kind": "mute", "board": "clock"},
        "mute cannot strike the clock; kinds that can: kill, clock-stop, clock-skip, clock-jitter",
    ),
    ({"kind": "hang", "board": "clock"}, "cannot strike the clock; kinds that can: kill, clock"),
    ({"kind": "lock-held", "board": "wave"}, "needs protocol lock; mailboxes of 'wave' that"),
    ({"kind": "masquerade", "board": "watch"}, "missing; no mailbox of 'watch' has a reader"),
    ({**WHEN, "when": "wave.status.state > 1"}, "must be mailbox.field == value, as in "),
    (
        {**WHEN, "when": "sea.status.state == done"},
        "no mailbox 'sea.status'; mailboxes: wave.status, wave.plan, watch.status, driven.status",
    ),
    (
        {**WHEN, "when": "driven.status.position == 1"},
        "no integer field 'position'; integer fields: echo, state, error, mode",
    ),
    (
        {**WHEN, "when": "wave.status.state == gone"},
        "'gone' is not a value of 'state'; valid: idle, executing, done, error",
    ),
]
PARAMETERS = [(kind, parameter) for kind in KINDS for parameter in kind.parameters]


@cache
def rack_for(locked: bool, lockstep: bool) -> tuple[RackConfig, Levels, Layout]:
    """Return the rack that can have every kind, but for those that need locks, or real time."""
    mode = "lockstep" if lockstep else "realtime"
    text = DRIVEN.replace('mode = "lockstep"', f'mode = "{mode}"')
    found = load_text(text + ('[protocol]\ndefault = "lock"\n' if locked else ""))
    return found, gather_facts(found).levels, resolve_layout(found)


def mistake_of(kind: Kind, lockstep: bool = False, **keys: Any) -> str:
    """Return the one mistake that a fault of that kind has, as its line."""
    board = TARGETS.get(kind.name, TARGETS.get(kind.where, "wave"))
    fault = FaultConfig.model_validate({"kind": kind.name, "board": board, **keys})
    rack = rack_for(kind.where == "lock", lockstep)
    (mistake,) = find_fault_mistakes([("fault[0]", fault)], *rack)
    return str(mistake)


def settings_with(*faults: Fault) -> tuple[str, str]:
    """Return settings of the driven rack: real time, and these faults."""
    return "clock.mode=realtime", f"fault=[{', '.join(map(inline, faults))}]"


@pytest.mark.parametrize(("fault", "line"), MISTAKES)
def test_a_mistake_is_reported_with_the_permitted_values(fault: Fault, line: str) -> None:
    found = find_mistake(DRIVEN, *settings_with(fault))
    assert line in found
    assert found.startswith("fault[0]")


TAKERS = ", ".join(kind.name for kind in KINDS if kind.takes_mailbox)
ONCE = "{} strikes once and has no duration; remove it"
UNFIT: tuple[tuple[str, Any, Callable[[Kind], bool], str], ...] = (
    ("strength", 2, lambda kind: True, "{} has no such parameter; parameters: "),
    ("phase", 0.5, lambda kind: not kind.within_tick, "{} cannot strike within a tick; kinds that"),
    ("for", 1, lambda kind: kind.once, ONCE),
    ("cycles", 1, lambda kind: kind.once, ONCE),
    (
        "mailbox",
        "wave.status",
        lambda kind: not kind.takes_mailbox,
        f"{{}} does not affect mailboxes; kinds that do: {TAKERS}",
    ),
)
"""Keys with a value, the kinds that cannot have them, and what is then said."""


@pytest.mark.parametrize("kind", [*KINDS], ids=lambda kind: kind.name)
def test_a_key_that_a_kind_cannot_have_is_one_mistake(kind: Kind) -> None:
    for key, value, lacks, why in UNFIT:
        if lacks(kind):
            place, _, said = mistake_of(kind, **{key: value}).partition(": ")
            assert place.startswith(f"fault[0].{key} = ")
            assert said.startswith(why.format(kind.name))


def test_an_unknown_parameter_of_a_fault_is_reported_with_the_known_ones() -> None:
    names = ", ".join(parameter.name for parameter in KINDS["drop"].parameters)
    assert mistake_of(KINDS["drop"], strength=2).endswith(f"parameters: {names}")


@pytest.mark.parametrize(("kind", "parameter"), PARAMETERS, ids=lambda given: given.name)
def test_a_parameter_out_of_range_is_reported_with_its_range(
    kind: Kind, parameter: Parameter
) -> None:
    for value in (parameter.least - 0.25, parameter.most + 0.25):
        line = mistake_of(kind, **{parameter.name: value})
        assert line.startswith(f"fault[0].{parameter.name} = {value!r}: out of range")
        assert f"{parameter.least:g} to {parameter.most:g}; {parameter}" in line
    if parameter.is_whole:
        line = mistake_of(kind, **{parameter.name: parameter.least + 0.5})
        assert "valid: whole numbers" in line


@pytest.mark.parametrize("kind", [k for k in KINDS if k.realtime], ids=lambda kind: kind.name)
def test_a_kind_that_needs_real_time_says_so_in_lockstep(kind: Kind) -> None:
    why = f"{kind.name} needs real time: in lockstep time waits for every task"
    assert mistake_of(kind, lockstep=True).startswith(f'fault[0].kind = "{kind.name}": {why}')


@pytest.mark.parametrize(
    "begin", [{"tick": 4}, {"at": 1.0}, {"when": "wave.status.state == executing"}]
)
def test_a_self_test_fails_at_the_start_and_at_no_other_time(begin: Fault) -> None:
    line = mistake_of(KINDS["self-test"], **begin)
    assert "self-test strikes as the board starts; remove it" in line


def test_a_lock_is_held_only_where_the_mailbox_has_one() -> None:
    fault = {"kind": "lock-held", "board": "wave", "mailbox": "wave.status"}
    setting = 'protocol.mailbox={ "watch.status" = "lock" }'
    found = find_mistake(DRIVEN, *settings_with(fault), setting)
    assert "mailboxes of 'wave' that use it: none" in found
    resolve(read_config(DRIVEN, (*settings_with(fault), LOCKED)))


def test_a_joint_that_the_arm_does_not_have_is_refused() -> None:
    found = find_mistake("nasrem", 'fault=[{ kind = "sensor-nan", board = "servo", joint = 6 }]')
    assert "joint = 6: out of range; valid: whole numbers -1 to 5; joint, counted from 0" in found


def test_more_faults_than_a_run_can_have_are_refused() -> None:
    faults = [{"kind": "kill", "board": "wave", "tick": tick} for tick in range(FAULT_ENTRIES + 1)]
    why = f"too many faults; a run can have at most {FAULT_ENTRIES}"
    assert find_mistake(DRIVEN, *settings_with(*faults)) == f"fault = {len(faults)}: {why}"


def test_all_mistakes_of_all_faults_are_reported_at_once() -> None:
    faults = (
        {"kind": "kil", "board": "wve", "tick": 1, "at": 1.0},
        {
            "kind": "mute",
            "board": "wave",
            "mailbox": "sea",
            "when": "sea",
            "strength": 1,
            "for": 1,
            "cycles": 1,
        },
    )
    places = [mistake.place for mistake in find_mistakes(DRIVEN, *settings_with(*faults))]
    assert sorted(places) == sorted(
        [f"fault[0].{key}" for key in ("kind", "board", "at")]
        + [f"fault[1].{key}" for key in ("mailbox", "when", "strength", "cycles")]
    )
