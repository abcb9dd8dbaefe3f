"""Tests that a run, also one in real time, is repeated in lockstep with its operators' commands."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

import pytest

from rack.backplane.operator_table import Client, OperatorTable, Request
from rack.backplane.segment import Segment
from rack.backplane.words import System
from rack.boards.config import RackConfig, load, resolve
from rack.boards.config.commands import build_request, parse_command
from rack.tools.launch.launch import Beginning, run_rack
from rack.tools.monitor.display import Display
from rack.tools.monitor.snapshot import Snapshot
from rack.tools.recording.divergence import find_first_difference
from rack.tools.recording.entries import load_commands_from, load_operator_commands
from rack.tools.recording.history import list_misses
from rack.tools.recording.recording import Recording
from tests.boards.commanded_racks import COMMANDED, commands
from tests.tools.command_line import rack

pytestmark = pytest.mark.thorough

SECONDS = 0.8
HOLD = "level = 'upper', what = 'hold', tick = 40"
NAMED = """
from commanded_levels import Upper

class Named(Upper):
    def process(self, tick):
        super().process(tick)
        self.status.reason = f"rack command {self.context.rack}"
"""
"""A level that writes the name of its rack, as a servo level that waits to be enabled does."""
GIVEN = (("hold", 20), ("resume", 30), ("resume", 80), ("hold", 200))


class Commanding(Display):
    """An operator who commands a running rack when it reaches certain ticks."""

    period_s = 0.02

    def __init__(self, rack: str, given: Sequence[Request]) -> None:
        self._rack = rack
        self._given = [*given]

    def show(self, snapshot: Snapshot) -> None:
        """Give what is due, at once."""
        while self._given and snapshot.tick >= self._given[0].tick:
            with closing(Segment.attach(self._rack)) as segment:
                OperatorTable(segment).add_request(replace(self._given.pop(0), tick=-1))


class ByHand(Display):
    """An operator at a rack that is held before the tick of each command."""

    period_s = 0.01

    def __init__(self, rack: str, given: Sequence[tuple[Request, Client]]) -> None:
        self._rack = rack
        self._given = [*given]
        self._stack = ExitStack()

    def show(self, snapshot: Snapshot) -> None:
        """Command what is due, and step the rack to the next command."""
        segment = self._stack.enter_context(closing(Segment.attach(self._rack)))
        words = segment.words
        if not words[System.HELD]:
            return
        if self._given and words[System.HELD] - 1 == self._given[0][0].tick:
            request, client = self._given.pop(0)
            claim = OperatorTable(segment).claim_request(replace(request, tick=-1), client)
            self._stack.enter_context(claim)
        words[System.HOLD_AT] = self._given[0][0].tick + 1 if self._given else 0

    def close(self) -> None:
        """Leave the rack."""
        self._stack.close()


def requests(config: RackConfig, *commands: tuple[str, int]) -> tuple[Request, ...]:
    """Return commands to the upper level, each with its tick."""
    plan = resolve(config)
    tables = ({"level": "upper", "what": what, "tick": tick} for what, tick in commands)
    return tuple(
        build_request(parse_command(table), config, plan.published.levels, plan.layout)
        for table in tables
    )


def commanded(folder: Path, name: str, mode: str) -> Recording:
    """Return a run in which an operator gives commands that are not in the config.

    In lockstep they are given at fixed ticks, in real time at any tick.
    """
    file = folder / "commanded.toml"
    (folder / "named_levels.py").write_text(NAMED)
    text = COMMANDED.replace("commanded_levels:Upper", "named_levels:Named")
    file.write_text(text.replace("python_path = [", f'python_path = ["{folder}", '))
    settings = (f"name={name}", f"clock.mode={mode}", commands(HOLD))
    config = load(file, settings)
    given = requests(config, *GIVEN)
    run = folder / "one"
    if mode == "lockstep":
        run_rack(config, SECONDS, run, Display(), beginning=Beginning(requests=given))
    else:
        run_rack(config, SECONDS, run, Commanding(name, given))
    return Recording(run)


def continued(one: Recording, at: float, name: str, *settings: str) -> Recording:
    """Return the run beside another one that continues it without a note."""
    folder = one.folder.with_name(name)
    options = [option for setting in settings for option in ("--set", setting)]
    words = ("--from", f"{one.folder}@{at}", "--seconds", SECONDS, "--out", folder, "--json")
    done = rack("run", *words, *options)
    assert not done.stderr
    assert json.loads(done.stdout)["recording"] == "complete"
    return Recording(folder)


def check_repetition(one: Recording, two: Recording, ticks: Sequence[int]) -> None:
    """Check that a run equals the one that it continues, with commands at these ticks."""
    assert find_first_difference(one, two) is None
    assert one.end_counts["outcome"]["digest"] == two.end_counts["outcome"]["digest"]
    assert two.read_signal("upper.operator", "tick").tolist() == ticks


@pytest.fixture(scope="module")
def in_lockstep(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A lockstep run whose operator gives commands that are not in the config."""
    folder = tmp_path_factory.mktemp("lockstep")
    return commanded(folder, f"test-repeated-{os.getpid()}", "lockstep")


def test_an_operators_command_is_not_mistaken_for_one_of_the_config(in_lockstep: Recording) -> None:
    assert load_operator_commands(in_lockstep) == requests(in_lockstep.rack_config, *GIVEN)


@pytest.mark.parametrize(("at", "ticks"), [(0.0, [20, 30, 40, 80, 200]), (0.3025, [200])])
def test_a_lockstep_run_continues_from_any_tick_with_its_operators_commands(
    in_lockstep: Recording, at: float, ticks: list[int]
) -> None:
    two = continued(in_lockstep, at, f"from-{at}")
    check_repetition(in_lockstep, two, ticks)
    # Under a name of its own, the rack writes the name of the original one.
    name = in_lockstep.rack_config.name
    assert set(two.read_signal("upper.status", "reason").tolist()) == {f"rack command {name}"}


def test_a_repeated_run_without_the_commands_differs(in_lockstep: Recording) -> None:
    # The run's config has no command but the first one.
    again = load(in_lockstep.folder / "config.toml", [])
    assert [command.tick for command in again.command] == [40]
    folder = in_lockstep.folder.with_name("without")
    run_rack(again, 0.1, folder, Display())
    difference = find_first_difference(in_lockstep, Recording(folder))
    assert difference is not None
    assert difference.tick == GIVEN[0][1]


@pytest.mark.alone
def test_a_run_in_real_time_is_repeated_equal_up_to_its_first_miss(
    rack_name: str, tmp_path: Path
) -> None:
    one = commanded(tmp_path, rack_name, "realtime")
    two = continued(one, 0.0, "two")
    assert two.rack_config.clock.mode == "lockstep"
    missed = [miss["tick"] for miss in list_misses(one)]
    difference = find_first_difference(one, two)
    if missed:
        # Each message until then is the same; what comes later may be.
        assert difference is None or difference.tick >= missed[0]
    else:
        assert difference is None


@pytest.fixture(scope="module")
def by_hand(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """A lockstep run whose operator gives such a command at tick 140, and leases one at 260."""
    folder = tmp_path_factory.mktemp("by-hand")
    (folder / "commanded.toml").write_text(COMMANDED)
    name = f"test-by-hand-{os.getpid()}"
    settings = (f"name={name}", "clock.mode=lockstep", commands(HOLD))
    config = load(folder / "commanded.toml", settings)
    given = requests(config, ("resume", 140), ("hold", 260))
    clients = (Client.WAITS, Client.LEASES)
    with closing(ByHand(name, [*zip(given, clients, strict=True)])) as operator:
        run_rack(config, SECONDS, folder / "one", operator, step=True)
    one = Recording(folder / "one")
    assert one.read_signal("upper.operator", "tick").tolist() == [40, 140, 260]
    return one


def test_a_run_continues_after_the_last_command_of_its_operators(by_hand: Recording) -> None:
    check_repetition(by_hand, continued(by_hand, 0.7, "after"), [])


def test_a_command_that_waits_in_a_snapshot_is_issued_once(by_hand: Recording) -> None:
    two = continued(by_hand, 0.3, "two")
    check_repetition(by_hand, two, [140, 260])
    # Those that two repeats wait in the snapshot at tick 240.
    check_repetition(two, continued(two, 0.6, "three"), [260])


def test_a_branch_adds_its_commands_to_the_repeated_ones(by_hand: Recording) -> None:
    earlier = "level = 'upper', what = 'hold', tick = 200"
    two = continued(by_hand, 0.25, "branch", commands(HOLD, earlier))
    assert two.read_signal("upper.operator", "tick").tolist() == [140, 200, 260]


def test_commands_in_a_flight_recorder_are_repeated_to_the_end_of_a_stretch(
    by_hand: Recording,
) -> None:
    flight = Recording(by_hand.folder)
    flight.kept = [(0, 200), (240, 320)]
    found = [[one.tick for one in load_commands_from(flight, tick)] for tick in (0, 100, 250)]
    assert found == [[40, 140], [140], [260]]
