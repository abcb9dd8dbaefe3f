"""The bench of responses: commands drawn at random ticks, and twins of a run that prove its
serials."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from random import Random

import pytest

from rack.boards.config import load, rack_timing, wire
from rack.boards.config.schema import CommandConfig
from rack.levels.timing.command_path import command_paths
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.response import (
    RUN_S,
    CommandedRun,
    ResponseRuns,
    compare,
    draw,
    first_difference,
    holds_of_moving_arm,
    run_commands,
)
from rack.tools.recording.recording import Recording
from rack.tools.timing.operator_response import response_of
from tests.shared_runs import nasrem_run

pytestmark = pytest.mark.thorough


def test_commands_are_drawn_with_room_for_each_response_and_a_seed_draws_the_same() -> None:
    config = load("nasrem")
    layout = wire(config)
    found = command_paths(rack_timing(config, layout), layout)
    drawn = draw(found, config.clock_ns, Random(7), 100)
    assert drawn == draw(found, config.clock_ns, Random(7), 100)
    assert drawn != draw(found, config.clock_ns, Random(8), 100)
    ticks = [(command.tick or 0, found[command.level].longest) for command in drawn]
    assert all(tick + longest < following for (tick, longest), (following, _) in pairwise(ticks))
    assert ticks[-1][0] + ticks[-1][1] < RUN_S / 0.0025
    assert [command.what for command in drawn] == ["hold", "resume"] * (len(drawn) // 2)


@pytest.mark.slow
def test_the_torque_of_a_run_differs_from_its_twins_at_the_predicted_ticks(
    rack_name: str, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    config = load("nasrem", [f"name={rack_name}", "clock.mode=lockstep"])
    told = [
        ("primitive", "hold", 2243),
        ("primitive", "resume", 2330),
        ("elemental_move", "hold", 2500),
    ]
    given = [CommandConfig(level=level, what=what, tick=tick) for level, what, tick in told]
    recording = run_commands(config, given, tmp_path / "run", 6.9)
    response = response_of(recording)
    assert response is not None
    assert response.held
    moving = holds_of_moving_arm(recording, response)
    assert [command.level for command in moving] == ["primitive", "elemental_move"]
    assert first_difference(recording, recording, "servo.status") is None
    # 2243 is read at 2248, and at 2256; 2500 at 2600, 2704 and 2712. Without the first there is no
    # command at all.
    assert [command.predicted for command in moving] == [2256, 2712]
    assert (
        first_difference(recording, Recording(nasrem_run(tmp_path_factory)), "servo.status") == 2256
    )
    twin = compare(
        config, CommandedRun(given, recording), moving[1], "servo.status", tmp_path / "twin"
    )
    assert (twin.differs, twin.agrees) == (2712, True)


@pytest.mark.slow
def test_a_bench_measures_as_many_as_asked_for() -> None:
    found = ResponseRuns("nasrem", "lockstep", 3, Progress()).measure(2, twins=0)
    assert found.held
    assert len(found.response.measured) >= 2
