"""Responses to an operator: commands drawn at random ticks, and twins of a run that prove its
serials."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from random import Random

import pytest

from rack.boards.config import load, rack_timing, wire
from rack.boards.config.schema import CommandConfig
from rack.levels.timing.command_path import command_paths
from rack.tools.lab.reproduction.experiments import response
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.response import (
    COMMANDS,
    RUN_S,
    draw_commands,
    first_difference,
    measure_response,
)
from rack.tools.recording.recording import Recording
from tests.shared_runs import nasrem_run

pytestmark = pytest.mark.thorough


def test_commands_are_drawn_with_room_for_each_response_and_a_seed_draws_the_same() -> None:
    config = load("nasrem")
    layout = wire(config)
    found = command_paths(rack_timing(config, layout), layout)
    drawn = draw_commands(found, config.clock_ns, Random(7))
    assert 2 <= len(drawn) <= COMMANDS
    assert drawn == draw_commands(found, config.clock_ns, Random(7))
    assert drawn != draw_commands(found, config.clock_ns, Random(8))
    ticks = [(command.tick or 0, found[command.level].longest) for command in drawn]
    assert all(tick + longest < following for (tick, longest), (following, _) in pairwise(ticks))
    assert ticks[-1][0] + ticks[-1][1] < RUN_S / 0.0025
    assert [command.what for command in drawn] == ["hold", "resume"] * (len(drawn) // 2)


@pytest.mark.slow
def test_the_torque_of_a_run_differs_from_its_twins_at_the_predicted_ticks(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = [
        ("primitive", "hold", 2243),
        ("primitive", "resume", 2330),
        ("elemental_move", "hold", 2500),
    ]
    given = [CommandConfig(level=level, what=what, tick=tick) for level, what, tick in told]
    monkeypatch.setattr(response, "draw_commands", lambda *arguments: given)
    monkeypatch.setattr(response, "RUN_S", 6.9)
    workshop = Workshop(tmp_path, share=True)
    workshop.prepare()
    found = measure_response(workshop, "lockstep", twins=2)
    assert found.response.held
    assert len(found.response.measured) == len(given)
    # 2243 is read at 2248, and at 2256; 2500 at 2600, 2704 and 2712.
    assert [(twin.level, twin.predicted, twin.agrees) for twin in found.twins] == [
        ("primitive", 2256, True),
        ("elemental_move", 2712, True),
    ]
    # Without the first command there is none at all.
    recording = Recording(tmp_path / "runs" / "response-lockstep")
    assert first_difference(recording, recording, "servo.status") is None
    whole = Recording(nasrem_run(tmp_path_factory))
    assert first_difference(recording, whole, "servo.status") == 2256
