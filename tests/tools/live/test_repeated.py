"""A run without checkpoints, in real time too, is repeated in lockstep with what its operators
commanded."""

from __future__ import annotations

import json
from collections.abc import Sequence
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from rack.backplane.operator_table import OperatorTable, Request
from rack.backplane.segment import Segment
from rack.boards.config import load, resolve
from rack.boards.config.commands import asked, request
from rack.tools.live.display import Display
from rack.tools.live.launch import Beginning, run_rack
from rack.tools.live.snapshot import Snapshot
from rack.tools.recording.divergence import first_difference
from rack.tools.recording.history import misses
from rack.tools.recording.recording import Recording
from tests.boards.commanded_racks import COMMANDED, commands
from tests.tools.command_line import rack

SECONDS = 2.0
HOLD = "level = 'upper', what = 'hold', tick = 40"


class Commanding(Display):
    """An operator who commands a running rack when it is seen to have reached a tick."""

    period_s = 0.02

    def __init__(self, rack: str, given: Sequence[Request]) -> None:
        self._rack = rack
        self._given = [*given]

    def show(self, snapshot: Snapshot) -> None:
        """Give what is due, at once."""
        while self._given and snapshot.tick >= self._given[0].tick:
            with closing(Segment.attach(self._rack)) as segment:
                OperatorTable(segment).add(replace(self._given.pop(0), tick=-1))


def commanded(folder: Path, name: str, mode: str) -> Recording:
    """Return a run of 2 s in which an operator commands what no config has: in lockstep at given
    ticks, in real time whenever it comes."""
    file = folder / "commanded.toml"
    file.write_text(COMMANDED)
    settings = (f"name={name}", f"clock.mode={mode}", "record.checkpoint_s=0", commands(HOLD))
    config = load(file, settings)
    layout = resolve(config).layout
    given = [
        request(asked({"level": "upper", "what": what, "tick": tick}), config, layout)
        for what, tick in (("resume", 80), ("hold", 200))
    ]
    run = folder / "one"
    if mode == "lockstep":
        run_rack(config, SECONDS, run, Display(), begins=Beginning(requests=tuple(given)))
    else:
        run_rack(config, SECONDS, run, Commanding(name, given))
    return Recording(run)


def repeated(one: Recording, folder: Path, at: float = 0.0) -> Recording:
    """Return the run that goes on from it."""
    arguments = ("--from", f"{one.folder}@{at}", "--seconds", SECONDS, "--out", folder, "--json")
    done = rack("run", *arguments)
    said = (
        f"--from {one.folder}@{at}: {one.folder} has no checkpoints: it is repeated in lockstep"
        " from its beginning, with 2 commands of its operators"
    )
    assert done.stderr.splitlines() == [said]
    assert json.loads(done.stdout)["recording"] == "complete"
    return Recording(folder)


@pytest.mark.slow
def test_a_run_in_lockstep_is_repeated_with_its_operators_commands(
    rack_name: str, tmp_path: Path
) -> None:
    one = commanded(tmp_path, rack_name, "lockstep")
    two = repeated(one, tmp_path / "two")
    assert first_difference(one, two) is None
    assert two.signal("upper.operator", "tick").tolist() == [40, 80, 200]
    assert one.ended["outcome"]["digest"] == two.ended["outcome"]["digest"]


@pytest.mark.slow
@pytest.mark.parametrize("at", [0.3, 1.2025])
def test_it_goes_on_from_any_tick_as_it_did(rack_name: str, tmp_path: Path, at: float) -> None:
    one = commanded(tmp_path, rack_name, "lockstep")
    two = repeated(one, tmp_path / "two", at)
    assert first_difference(one, two) is None
    assert two.signal("upper.operator", "tick").tolist() == [200] * (at < 0.5)
    assert one.ended["outcome"]["digest"] == two.ended["outcome"]["digest"]


@pytest.mark.slow
def test_the_commands_are_what_makes_it_equal(rack_name: str, tmp_path: Path) -> None:
    one = commanded(tmp_path, rack_name, "lockstep")
    # The run's config has no command but the first one.
    again = load(one.folder / "config.toml", [])
    assert [command.tick for command in again.command] == [40]
    run_rack(again, SECONDS, tmp_path / "two", Display())
    difference = first_difference(one, Recording(tmp_path / "two"))
    assert difference is not None
    assert 80 <= difference.tick < 120


@pytest.mark.slow
@pytest.mark.alone
def test_a_run_in_real_time_is_repeated_equal_up_to_its_first_miss(
    rack_name: str, tmp_path: Path
) -> None:
    one = commanded(tmp_path, rack_name, "realtime")
    two = repeated(one, tmp_path / "two")
    assert two.rack_config.clock.mode == "lockstep"
    missed = [miss["tick"] for miss in misses(one)]
    difference = first_difference(one, two)
    if missed:
        # Each message until then is the same; what comes later may be.
        assert difference is None or difference.tick >= missed[0]
    else:
        assert difference is None
