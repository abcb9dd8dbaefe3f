"""Systems next to each other: figures of racks by config and run, whatever their levels are."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.boards.config import load
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.systems import (
    hold_for,
    prediction,
    system_experiment,
)
from tests.boards.conftest import PLAIN
from tests.boards.vector_racks import JOINTED


def test_the_highest_level_that_responds_within_the_run_is_held(tmp_path: Path) -> None:
    config = load("nasrem")
    found = {seconds: hold_for(config, seconds) for seconds in (10.0, 2.0, 0.1)}
    long, short, none = found.values()
    assert long is not None
    assert (long.level, long.what, long.tick) == ("task", "hold", 2000)
    assert short is not None
    assert (short.level, none) == ("elemental_move", None)
    # A rack without levels above each other promises no response.
    path = tmp_path / "lone.toml"
    path.write_text(PLAIN.replace('below = "wave"', 'reads = { status = "wave.status" }'))
    lone = load(path)
    assert prediction(lone).command_ms == 0
    assert hold_for(lone, 10.0) is None


@pytest.mark.thorough
@pytest.mark.slow
def test_a_rack_is_compared_by_its_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("jointed.toml").write_text(JOINTED)
    workshop = Workshop(tmp_path, share=True)
    workshop.prepare()
    experiment = system_experiment("jointed.toml")
    found = experiment.record(experiment.document(experiment.make(workshop)))
    assert (found.rack, found.failure, found.worked) == ("jointed.toml", "", True)
    assert found.predicted.levels == ("path", "joint1 ... joint3", "arm")
    ran = found.realtime
    assert ran.command_ms is not None
    assert ran.command_ms["min"] == 25.0
    assert ran.hold is not None
    assert ran.hold.level == "path"
    assert ran.hold.measured_ms is not None
    assert ran.hold.measured_ms >= 25.0
