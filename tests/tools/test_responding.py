"""The response to an operator: predicted by hand's arithmetic, measured to the tick, and proved by twins of a run."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from random import Random

import numpy as np
import pytest

from rack.boards.config import load, wire
from rack.boards.config.schema import RackConfig
from rack.boards.operating.config import CommandConfig
from rack.tools.bench.response import Bench
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.recording import Recording
from rack.tools.responding.course import Course, courses
from rack.tools.responding.plot import plot
from rack.tools.responding.response import Response, response_of
from rack.tools.responding.schedule import RUN_S, draw
from rack.tools.responding.shown import show
from rack.tools.responding.trial import run
from rack.tools.responding.twin import candidates, compare, first_difference
from tests.boards.told_racks import TOLD

MakeConfig = Callable[..., RackConfig]
NASREM = Course(("task", "elemental_move", "primitive", "servo"), (400, 100, 8, 1), 1, True)


@pytest.mark.parametrize(
    ("given", "sampled", "acts"),
    [
        # Visible a tick later; each level's next release on the grid: 400, 800, 904 (900 is none of every 8), 912.
        (0, 400, 912),
        (399, 400, 912),
        (400, 800, 1312),
        # 1200 + 400 + 100 = 1700 is none of every 8: 1704, and its slice.
        (800, 1200, 1712),
    ],
)
def test_a_command_is_followed_from_release_to_release(given: int, sampled: int, acts: int) -> None:
    assert NASREM.samples_at(given + 1) == sampled
    assert NASREM.acts_at(given + 1) == acts


def test_bounds_are_those_of_the_paper_and_of_the_grid() -> None:
    assert NASREM.bound_eq_3_2 == 4 * 400
    assert NASREM.sum_eq_3_3 == 400 + 100 + 8 + 1
    # A cycle of the first level until it is read, the sum, and up to 4 ticks: 100 is no multiple of 8.
    assert NASREM.longest == 400 + 509 + 4


@pytest.mark.parametrize("cycles", [(400, 100, 8, 1), (12, 8, 3), (7, 5), (30, 12, 9, 2), (4,)])
def test_the_longest_on_the_grid_is_met_and_never_passed(cycles: tuple[int, ...]) -> None:
    course = Course(tuple(map(str, cycles)), cycles, 1, True)
    grid = int(np.lcm.reduce(cycles))
    found = [course.response(given, course.acts_at(given + 1)) for given in range(2 * grid)]
    assert max(found) <= course.longest
    if len(cycles) <= 2:
        assert max(found) == course.longest


def test_courses_begin_at_every_level_that_can_be_commanded() -> None:
    config = load("nasrem")
    found = courses(config, wire(config))
    assert found["task"] == NASREM
    assert found["primitive"] == Course(("primitive", "servo"), (8, 1), 1, True)
    assert list(found) == ["task", "elemental_move", "primitive", "servo"]


def test_commands_are_drawn_with_room_for_each_response_and_a_seed_draws_the_same() -> None:
    config = load("nasrem")
    found = courses(config, wire(config))
    drawn = draw(found, config.clock_ns, Random(7), 100)
    assert drawn == draw(found, config.clock_ns, Random(7), 100)
    assert drawn != draw(found, config.clock_ns, Random(8), 100)
    ticks = [(command.tick or 0, found[command.level].longest) for command in drawn]
    assert all(tick + longest < following for (tick, longest), (following, _) in pairwise(ticks))
    assert ticks[-1][0] + ticks[-1][1] < RUN_S / 0.0025
    assert [command.what for command in drawn] == ["hold", "resume"] * (len(drawn) // 2)


@pytest.fixture
def config(rack_name: str, tmp_path: Path) -> MakeConfig:
    path = tmp_path / "told.toml"
    path.write_text(TOLD)
    return lambda *settings: load(path, [f"name={rack_name}", *settings])


def measured(config: RackConfig, folder: Path, *given: CommandConfig) -> tuple[Recording, Response]:
    recording = run(config, given, folder, 1.0)
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
    recording = run(config(), (), tmp_path / "run", 0.5)
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


def test_the_torque_of_a_run_differs_from_its_twins_at_the_predicted_ticks(rack_name: str, tmp_path: Path) -> None:
    config = load("nasrem", [f"name={rack_name}", "clock.mode=lockstep"])
    ticks = {"primitive": (2243, 2330), "elemental_move": (2500, 2830)}
    given = [
        CommandConfig(level=level, what=what, tick=tick)
        for level, pair in ticks.items()
        for what, tick in zip(("hold", "resume"), pair, strict=True)
    ]
    recording = run(config, given, tmp_path / "run", 7.5)
    response = response_of(recording)
    assert response is not None
    assert response.held
    moving = candidates(recording, response)
    assert [command.level for command in moving] == ["primitive", "elemental_move"]
    twins = [compare(config, given, recording, command, tmp_path / command.level) for command in moving]
    # 2243 is read at 2248, and at 2256; 2500 at 2600, 2704 and 2712.
    assert [(twin.differs, twin.agrees) for twin in twins] == [(2256, True), (2712, True)]


def test_a_bench_measures_as_many_as_asked_for() -> None:
    found = Bench("nasrem", "lockstep", 3, Progress()).measure(2, twins=0)
    assert found.held
    assert len(found.response.measured) >= 2


def test_runs_that_are_equal_differ_nowhere(rack_name: str, tmp_path: Path) -> None:
    config = load("nasrem", [f"name={rack_name}", "clock.mode=lockstep"])
    first, second = (run(config, (), tmp_path / folder, 0.1) for folder in ("a", "b"))
    assert first_difference(first, second) is None
