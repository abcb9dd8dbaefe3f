"""The response to an operator, measured with the precision of a tick."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from rack.boards.config import load
from rack.boards.config.command import CommandConfig
from rack.boards.config.schema import RackConfig
from rack.tools.console.tables import render_text
from rack.tools.lab.benches.observed import record_rack
from rack.tools.timing.operator_response import OperatorResponse, measure_response, plot_response
from tests.boards.commanded_racks import COMMANDED

MakeConfig = Callable[..., RackConfig]


@pytest.fixture
def config(rack_name: str, tmp_path: Path) -> MakeConfig:
    path = tmp_path / "told.toml"
    path.write_text(COMMANDED)
    return lambda *settings: load(path, [f"name={rack_name}", *settings])


def run_and_measure(config: RackConfig, folder: Path, *given: CommandConfig) -> OperatorResponse:
    response = measure_response(
        record_rack(config.model_copy(update={"command": given}), 1.0, folder).recording
    )
    assert response is not None
    return response


@pytest.fixture(scope="module")
def response(tmp_path_factory: pytest.TempPathFactory) -> OperatorResponse:
    """Return the response of a run with three commands that all take effect."""
    folder = tmp_path_factory.mktemp("responses")
    (folder / "told.toml").write_text(COMMANDED)
    given = [("upper", "hold", 101), ("upper", "resume", 176), ("lower", "hold", 250)]
    commands = [CommandConfig(level=level, what=what, tick=tick) for level, what, tick in given]
    return run_and_measure(
        load(folder / "told.toml", [f"name=test-response-{os.getpid()}"]), folder / "run", *commands
    )


@pytest.mark.slow
def test_every_command_of_a_run_comes_at_its_predicted_tick(
    response: OperatorResponse, tmp_path: Path
) -> None:
    assert [(c.given, c.sampled, c.predicted, c.acts) for c in response.commands] == [
        (101, 104, 112, 112),
        (176, 184, 192, 192),
        (250, 251, 251, 251),
    ]
    assert response.is_within_bounds
    assert "0 " in "\n".join(render_text(response.format_blocks())).splitlines()[-1]
    pictures = plot_response(response, tmp_path)
    assert [picture.suffix for picture in pictures] == [".png", ".svg"]
    assert all(picture.stat().st_size > 1000 for picture in pictures)


@pytest.mark.slow
def test_commands_without_effect_have_distinct_fates(config: MakeConfig, tmp_path: Path) -> None:
    given = [
        CommandConfig(level="upper", what="goto", home=True, tick=50),
        CommandConfig(level="upper", what="hold", tick=101),
        # This command overtakes the previous one on its way down.
        CommandConfig(level="lower", what="hold", tick=105),
        CommandConfig(level="upper", what="resume", tick=398),
    ]
    response = run_and_measure(config(), tmp_path / "run", *given)
    assert [command.fate for command in response.commands] == [
        "refused",
        "superseded",
        "acted on",
        "run over",
    ]
    assert len(response.measured_commands) == 1
    assert (
        "not measured: 1 to upper (refused), 2 to upper (superseded), 4 to upper (run over)"
        in "\n".join(render_text(response.format_blocks()))
    )


@pytest.mark.slow
def test_a_response_at_another_tick_or_beyond_a_bound_is_detected(
    response: OperatorResponse,
) -> None:
    late = replace(response.commands[0], acts=113)
    assert not replace(response, commands=(late,)).is_within_bounds
    assert replace(response, commands=(late,)).mispredicted_commands == [late]
    assert replace(response, commands=(late,)).commands_beyond_bound == []
    ticks = response.commands[0].ticks
    assert ticks is not None
    lost = replace(response.commands[0], acts=101 + 40, ticks=ticks + 40)
    assert replace(response, commands=(lost,), lockstep=False).commands_beyond_bound == [lost]
