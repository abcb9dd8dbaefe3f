"""Responses to an operator: commands drawn at random ticks, and twins of a run that prove its
serials."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.boards.config.schema import CommandConfig
from rack.tools.lab.reproduction.experiments import response
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.response import (
    first_difference,
    measure,
)
from rack.tools.recording.recording import Recording
from tests.shared_runs import nasrem_run

pytestmark = pytest.mark.thorough


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
    found = measure(workshop, "lockstep", twins=2)
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
