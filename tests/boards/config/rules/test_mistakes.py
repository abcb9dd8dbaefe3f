"""Mistakes of a config: all of them at once, each with its place, its value and what is
permitted."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest

from rack.backplane.address_map import AddressMap
from rack.boards.config import load, resolve
from rack.boards.config.rules import levels
from tests.boards.config.mistakes import find_mistake, find_mistakes

Write = Callable[[str, str], Path]


MISTAKES = [
    ("clock.periodms=1", "clock.periodms = 1: unknown key; did you mean 'period_ms'?"),
    ("board.upper.slot=22", "board.upper.slot = 22: should be less than or equal to 21; slot in"),
    ("board.upper.slot=1", "slot 1 is the clock's"),
    ("board.upper.slot=3", "board.lower.slot = 3: the slot is already taken by board.upper.slot"),
    ("name='../x'", 'name = "../x": '),
    ("clock.period_ms=2.4999995", "clock.period_ms = 2.4999995: not a whole number of ns"),
    (
        "board.upper.rate_hz=60",
        "60 Hz does not divide the 400 Hz clock; nearest: 57.14 Hz (every 7 ticks), 66.67 Hz"
        " (every 6 ticks)",
    ),
    ("board.upper.every=4", "every is also given"),
    ("clock.speed=2", "clock.speed = 2.0: lockstep runs as fast as it can"),
    ("board.lower.above=uper", '= "uper": no other board has this name; boards: upper'),
    ("clock.period_ms=true", "clock.period_ms = true: should be a valid number; tick period [ms]"),
    (
        "clock={ mode = 'realtime', speed = 500 }",
        "clock.speed = 500.0: a tick would take 0.005 ms of real time; at least 0.01 ms are valid",
    ),
    ("board.lower.rate_hz=1e-5", "a cycle would take 40000000 ticks; it can take up to 1000000"),
    ("board.upper.exchange={ command = {} }", ".command: no such port of the executor; ports:"),
    (
        "board.upper.exchange={ below = { every = 3, phase = 3 } }",
        "board.upper.exchange.below.phase = 3: must be less than every: 0 to 2 cycles",
    ),
    (
        "board.upper.exchange={ below = { every = 2, asynchronous = true } }",
        "exchange.below.every = 2: an asynchronous port is read in every cycle; must be 1",
    ),
    ("board.lower.coupling=none", 'must be "tight" or "loose" with a planner'),
    ("board.upper.coupling=tight", 'must be "none" without a planner'),
    ("board.lower.coupling=loose", "planner_slot: missing; a loosely coupled planner has"),
    ("board.lower.planner_slot=9", 'only for a planner with coupling = "loose"'),
    ("board.lower.planner_priority=5", "must be below the executor's priority, 0"),
    ("board.upper.wake=poll", "to itself; core 0 also runs clock, lower, lower.planner"),
    ("board.lower.ends_run=true", "only one board can end the run; 'upper' already does"),
    (
        "board.upper.executor=two_levels:Stateless",
        "board.upper.ends_run = true: its status has no field 'state' of State",
    ),
    ("scene.motion=[{ body = 'bar', at = 1, to = [0, 0, 0] }]", "no such obstacle"),
    ("board.upper.executor='no_levels:Upper'", "cannot import 'no_levels': ModuleNotFoundError"),
    ("board.upper.executor='two_levels:Unfinished'", "'Unfinished' does not implement: process"),
    ("board.upper.reads={ below = 'lower.state' }", "no task writes it; mailboxes: upper.command"),
    (
        "board.upper.reads={ below = 'upper.command' }",
        "carries count_command 1; the port needs count_status 1",
    ),
    ("board.upper.reads={ s = 'lower.status' }", "the executor has no such port; ports: below"),
    ("board.lower.executor='two_levels:PlanWriter'", "mailbox lower.plan"),
    ("protocol.mailbox={ 'lower.state' = 'lock' }", '.lower.state = "lock": no such mailbox'),
    ("board.lower.planner='two_levels:SizedPlanner'", "count_plan 1; the port needs small_plan 1"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("setting", "expected"), MISTAKES)
def test_a_mistake_is_reported_alone_with_place_value_and_what_is_permitted(
    small: Path, setting: str, expected: str
) -> None:
    assert expected in find_mistake(small, setting)


def test_names_missing_in_a_model_are_reported_with_the_existing_ones(write: Write) -> None:
    text = """
extends = ["nasrem"]
[robot]
joints = ["j1", "j2", "j3", "j4", "j5", "j9"]
tool = "palm"
[scene]
objects = ["block1", "block2", "peg", "cup"]
supports = ["shelf"]
"""
    found = {mistake.place: mistake.why for mistake in find_mistakes(write("mine.toml", text))}
    assert set(found) == {"robot.joints", "robot.tool", "scene.objects", "scene.supports"}
    assert found["robot.joints"].startswith(
        "no joint 'j9' in the model; it has: j1, j2, j3, j4, j5, j6"
    )
    assert found["scene.supports"].startswith(
        "no geom 'shelf' in the model; it has: pedestal, floor, table"
    )


def test_a_config_whose_boards_are_all_wrong_still_has_its_other_mistakes_reported() -> None:
    settings = [f"board.level.{setting}" for setting in ("slot=99", "params.plan_ms=1")]
    settings += ["timing.small_share=2", "scene.motion=[{ body = 'bar', at = 1, to = [0, 0, 0] }]"]
    assert {mistake.place for mistake in find_mistakes("fig2", *settings)} == {
        "board.level.slot",
        "timing.small_share",
        "scene.motion[0].body",
    }


def test_a_mistake_is_one_line_whatever_its_key_contains(write: Write) -> None:
    odd = write(
        "odd.toml", f'extends = ["fig2"]\n"two\\nlines\\u001b[31m" = 1\n"{"k" * 5000}" = 1\n'
    )
    lines = [str(mistake) for mistake in find_mistakes(odd)]
    assert len(lines) == 2
    assert all(line.isprintable() and len(line) < 500 for line in lines)


def test_a_segment_too_large_for_any_machine_is_refused(small: Path) -> None:
    found = find_mistake(small, "board.lower.rate_hz=0.001", "board.lower.within_cycles=10000")
    assert re.match(
        r"mailbox upper.command: \d+ messages are kept .*; at most 1073741824 are ", found
    )


def test_a_phase_is_less_than_the_period(small: Path) -> None:
    assert resolve(load(small, ["board.upper.phase=7"])).layout.find_task("upper").phase == 7
    assert "period: 0 to 7 ticks" in find_mistake(small, "board.upper.phase=8")


def test_a_segment_may_have_its_largest_size(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    layout = resolve(load(small)).layout
    size = AddressMap(layout).size
    monkeypatch.setattr(levels, "MAX_SEGMENT_BYTES", size)
    assert not [*levels.check_memory(layout)]
    monkeypatch.setattr(levels, "MAX_SEGMENT_BYTES", size - 1)
    (mistake,) = levels.check_memory(layout)
    assert f"needs {size} bytes; at most {size - 1} are possible" in mistake.why


@pytest.mark.parametrize(
    ("setting", "place"),
    [("noise=[0, -1, 0, 0, 0, 0]", "noise[1]"), ("resolution=-1", "resolution")],
)
def test_an_invalid_value_of_a_union_is_one_mistake(setting: str, place: str) -> None:
    found = find_mistake("nasrem", f"robot.sensors.{setting}")
    assert found.startswith(f"robot.sensors.{place} = -1: ")


def test_an_encoder_is_described_for_all_joints_or_for_each() -> None:
    six = "[1e-4, 1e-4, 1e-4, 1e-4, 1e-4, 1e-4]"
    resolve(load("nasrem", [f"robot.sensors.resolution={six}"]))
    found = find_mistake("nasrem", "robot.sensors.resolution=[1e-4, 1e-4]")
    assert found.startswith("robot.sensors.resolution")
    assert found.endswith("has 2 values but needs one for all joints, or one per joint: 6")


def test_lists_of_another_length_than_the_joints_are_reported_together() -> None:
    found = find_mistakes("nasrem", "robot.home=[0, 0]", "robot.jerk=[1]", "robot.model=none.xml")
    assert {mistake.place for mistake in found} == {"robot.home", "robot.jerk", "robot.model"}


STRICT = [
    ("protocol.default=lock", 'protocol.default = "lock"'),
    ("protocol.mailbox={ 'lower.status' = 'lock' }", 'protocol.mailbox.lower.status = "lock"'),
    ("board.upper.exchange={ below = { asynchronous = true } }", "board.upper.exchange.below."),
]


@pytest.mark.parametrize(("setting", "place"), STRICT)
def test_settings_that_make_runs_depend_on_timing_are_refused_by_strict(
    small: Path, setting: str, place: str
) -> None:
    assert resolve(load(small, [setting]))
    found = find_mistake(small, setting, "protocol.strict=true")
    assert found.startswith(place)
    assert "makes a run depend on timing, which protocol.strict = true refuses; must be " in found


def test_a_host_board_depends_on_timing() -> None:
    found = map(str, find_mistakes("penn", "protocol.strict=true"))
    (mistake,) = [line for line in found if line.startswith("host")]
    assert mistake.endswith("strict = true refuses; must be a board with a rate")


PARAMS = [
    ("fig2", "level.params.proces_ms=1", "= 1: unknown key; did you mean 'process_ms'?"),
    ("nasrem", "world.params.x=1", "= 1: unknown key; known: moved, turned, slow, resting"),
    ("nasrem", "primitive.params.braking=4", "= 4: should be less than or equal to 3; multiple"),
    ("nasrem", "servo.params.on_sensor_fault=stay", "= \"stay\": should be 'hold', 'stop' or"),
    # Of the planner alone.
    ("nasrem", "task.params.settling=-1", "= -1: should be greater than 0; longest time from"),
]


@pytest.mark.parametrize(("rack", "setting", "expected"), PARAMS)
def test_a_parameter_that_no_level_has_is_a_mistake(rack: str, setting: str, expected: str) -> None:
    found = find_mistake(rack, f"board.{setting}")
    assert found.startswith(f"board.{setting.partition('=')[0]} {expected}")


def test_every_mistake_of_parameters_is_reported() -> None:
    found = find_mistakes(
        "nasrem", "board.servo.params={ bandwidth = -1, damping = 9 }", "board.world.params.slow=0"
    )
    assert [mistake.place for mistake in found] == [
        "board.servo.params.bandwidth",
        "board.servo.params.damping",
        "board.world.params.slow",
    ]


def test_a_level_that_declares_no_parameters_accepts_any(small: Path) -> None:
    assert resolve(load(small, ["board.lower.params={ gain = 'high', deep = { on = true } }"]))


def test_a_users_own_level_declares_its_program(small: Path) -> None:
    own = "board.upper.executor='two_levels:Programmed'"
    assert resolve(load(small, [own, "task.count=[1, 2]"]))
    found = find_mistakes(small, own, "task={ count = [1, 'two'], counts = 3 }")
    assert [str(mistake).partition(";")[0] for mistake in found] == [
        'task.count[1] = "two": should be a valid integer',
        "task.counts = 3: unknown key",
    ]
    found = find_mistake(small, own, "task.count=[1, -2]")
    assert found == "task.count[1] = -2: nothing to count; objects: none"
