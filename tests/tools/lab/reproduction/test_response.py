"""Responses to an operator: the distance of commands, and the tick at which one takes effect."""

from __future__ import annotations

from itertools import pairwise

import pytest

from rack.boards.config import build_rack_timing, load, resolve_layout
from rack.boards.timing.command_path import find_command_paths
from rack.tools.lab.reproduction.experiments import response
from rack.tools.lab.reproduction.experiments.experiment import RUNS_FOLDER, Workshop
from rack.tools.lab.reproduction.experiments.response import (
    MAX_RUN_S,
    list_commands,
    run_with_commands,
)
from rack.tools.recording.recording import Recording

pytestmark = pytest.mark.thorough


def test_each_command_follows_the_longest_response_to_the_previous_one() -> None:
    config = load("nasrem")
    layout = resolve_layout(config)
    found = find_command_paths(build_rack_timing(config, layout), layout)
    commands = list_commands()
    assert {command.level for command in commands} == found.keys()
    ticks = [(command.tick or 0, found[command.level].longest) for command in commands]
    assert all(tick + longest < following for (tick, longest), (following, _) in pairwise(ticks))
    assert ticks[-1][0] + ticks[-1][1] < MAX_RUN_S / 0.0025


def test_the_torque_differs_from_a_run_without_commands_at_the_predicted_tick(
    nasrem: Recording, workshop: Workshop, monkeypatch: pytest.MonkeyPatch
) -> None:
    holds = (("primitive", 2243, 2330), ("elemental_move", 2500, 2760))
    monkeypatch.setattr(response, "HOLDS", holds)
    monkeypatch.setattr(response, "MAX_RUN_S", 6.9)
    found = run_with_commands(workshop, "lockstep")
    assert found.is_within_bounds
    # 2243 is read at 2248, and at 2256; 2500 at 2600, 2704 and 2712.
    predicted = {command.given: command.predicted for command in found.measured_commands}
    assert (predicted[2243], predicted[2500]) == (2256, 2712)
    folders = workshop.folder / RUNS_FOLDER / "response-lockstep", nasrem.folder
    first, second = (Recording(folder).read_signal("servo.status", "torque") for folder in folders)
    length = min(len(first), len(second))
    differing = (first[:length] != second[:length]).any(axis=1)
    ticks = Recording(folders[0]).read_signal("servo.status", "tick")
    assert ticks[:length][differing][0] == 2256
