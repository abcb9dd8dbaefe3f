"""The response to an operator, measured to the tick."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from rack.boards.config import load
from rack.boards.config.schema import RackConfig
from rack.boards.operating.config import CommandConfig
from rack.tools.answer import Failure
from rack.tools.bench.response import run_commands
from rack.tools.runs.recording import Recording
from rack.tools.timing.operator_response import OperatorResponse, plot, response_of, show
from tests.boards.told_racks import TOLD

MakeConfig = Callable[..., RackConfig]


@pytest.fixture
def config(rack_name: str, tmp_path: Path) -> MakeConfig:
    path = tmp_path / "told.toml"
    path.write_text(TOLD)
    return lambda *settings: load(path, [f"name={rack_name}", *settings])


def measured(config: RackConfig, folder: Path, *given: CommandConfig) -> tuple[Recording, OperatorResponse]:
    recording = run_commands(config, given, folder, 1.0)
    response = response_of(recording)
    assert response is not None
    return recording, response


def test_every_command_of_a_run_comes_at_its_predicted_tick(config: MakeConfig, tmp_path: Path) -> None:
    holds = [CommandConfig(level="upper", what=what, tick=tick) for what, tick in (("hold", 101), ("resume", 176))]
    last = CommandConfig(level="lower", what="hold", tick=250)
    _, response = measured(config(), tmp_path / "run", *holds, last)
    assert [(c.given, c.sampled, c.predicted, c.acts) for c in response.commands] == [
        (101, 104, 112, 112),
        (176, 184, 192, 192),
        (250, 251, 251, 251),
    ]
    assert response.held
    assert "0 " in response.text().splitlines()[-1]
    pictures = plot(response, tmp_path)
    assert [picture.suffix for picture in pictures] == [".png", ".svg"]
    assert all(picture.stat().st_size > 1000 for picture in pictures)


def test_what_no_torque_rests_on_is_told_apart(config: MakeConfig, tmp_path: Path) -> None:
    given = [
        CommandConfig(level="upper", what="goto", home=True, tick=50),
        CommandConfig(level="upper", what="hold", tick=101),
        # It overtakes the one before on its way down.
        CommandConfig(level="lower", what="hold", tick=105),
        CommandConfig(level="upper", what="resume", tick=398),
    ]
    _, response = measured(config(), tmp_path / "run", *given)
    assert [command.fate for command in response.commands] == ["refused", "overtaken", "acted on", "run over"]
    assert len(response.measured) == 1
    assert "not measured: 1 to upper (refused), 2 to upper (overtaken), 4 to upper (run over)" in response.text()


def test_a_response_off_its_tick_or_beyond_a_bound_is_seen(config: MakeConfig, tmp_path: Path) -> None:
    _, response = measured(config(), tmp_path / "run", CommandConfig(level="upper", what="hold", tick=101))
    late = replace(response.commands[0], acts=113)
    assert not replace(response, commands=(late,)).held
    assert replace(response, commands=(late,)).off == [late]
    assert replace(response, commands=(late,)).beyond == []
    lost = replace(response.commands[0], acts=101 + 40)
    assert replace(response, commands=(lost,), lockstep=False).beyond == [lost]


def test_a_run_without_commands_has_no_response(config: MakeConfig, tmp_path: Path) -> None:
    recording = run_commands(config(), (), tmp_path / "run", 0.5)
    assert response_of(recording) is None
    with pytest.raises(Failure, match="no operator commanded a level"):
        show(recording, tmp_path, as_json=False)


def test_a_run_in_real_time_has_responses_by_the_wall_clock(config: MakeConfig, tmp_path: Path) -> None:
    given = [CommandConfig(level="upper", what="hold", tick=101)]
    _, response = measured(config("clock.mode=realtime"), tmp_path / "run", *given)
    (command,) = response.commands
    assert command.wall_ms is not None
    # Given at tick 101, its cycle begins at 112 or later.
    assert command.wall_ms > 10 * 2.5
