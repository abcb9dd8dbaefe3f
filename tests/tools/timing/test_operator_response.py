"""The response to an operator, measured with the precision of a tick."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from rack.tools.console.tables import render_text
from rack.tools.recording.recording import Recording
from rack.tools.timing.operator_response import OperatorResponse, measure_response, plot_response
from tests.boards.commanded_racks import COMMANDED, commands
from tests.shared_runs import run_text

pytestmark = pytest.mark.slow


def run_and_measure(
    factory: pytest.TempPathFactory, *given: tuple[str, str, int]
) -> OperatorResponse:
    """Run a rack with commands: level, what and tick of each."""
    tables = [
        f"level='{level}', what='{what}', {'home=true, ' * (what == 'goto')}tick={tick}"
        for level, what, tick in given
    ]
    run = run_text(factory, COMMANDED, 1.0, commands(*tables))
    response = measure_response(Recording(run))
    assert response is not None
    return response


@pytest.fixture(scope="module")
def response(tmp_path_factory: pytest.TempPathFactory) -> OperatorResponse:
    """Return the response of a run with three commands that all take effect."""
    given = ("upper", "hold", 101), ("upper", "resume", 176), ("lower", "hold", 250)
    return run_and_measure(tmp_path_factory, *given)


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


def test_commands_without_effect_have_distinct_fates(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    response = run_and_measure(
        tmp_path_factory,
        ("upper", "goto", 50),
        ("upper", "hold", 101),
        # This command overtakes the previous one on its way down.
        ("lower", "hold", 105),
        ("upper", "resume", 398),
    )
    fates = [command.fate for command in response.commands]
    assert fates == ["refused", "superseded", "acted on", "run over"]
    assert len(response.measured_commands) == 1
    lines = "\n".join(render_text(response.format_blocks()))
    unmeasured = "1 to upper (refused), 2 to upper (superseded), 4 to upper (run over)"
    assert f"not measured: {unmeasured}" in lines


def test_a_response_at_another_tick_or_beyond_a_bound_is_detected(
    response: OperatorResponse,
) -> None:
    late = replace(response.commands[0], acts=113)
    found = replace(response, commands=(late,))
    assert not found.is_within_bounds
    assert (found.mispredicted_commands, found.commands_beyond_bound) == ([late], [])
    ticks = response.commands[0].ticks
    assert ticks is not None
    lost = replace(response.commands[0], acts=101 + 40, ticks=ticks + 40)
    assert replace(response, commands=(lost,), lockstep=False).commands_beyond_bound == [lost]
