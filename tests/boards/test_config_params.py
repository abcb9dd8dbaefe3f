"""Parameters of levels: checked against what the level declares, before anything starts."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.boards.config import load, names, wire
from rack.boards.errors import ConfigError

MISTAKES = {
    "unknown": ("fig2", "level.params.proces_ms=1", "= 1: unknown key; did you mean 'process_ms'?"),
    "of nothing known": ("nasrem", "world.params.x=1", "= 1: unknown key; known: moved, turned, slow, resting"),
    "text": ("fig2", "level.params.process_ms=lock", '= "lock": should be a valid number; X: the executor in a cycle'),
    "truth": ("nasrem", "servo.params.bandwidth=true", "= true: should be a valid number; natural frequency"),
    "range": ("nasrem", "primitive.params.braking=4", "= 4: should be less than or equal to 3; multiple of"),
    "choice": ("nasrem", "servo.params.on_sensor_fault=stay", "= \"stay\": should be 'hold', 'stop' or 'brake'"),
    "of the planner alone": ("nasrem", "task.params.settling=-1", "= -1: should be greater than 0; from the end"),
    "both": (
        "nasrem",
        "elemental_move.params.patience=nan",
        "= nan: should be a finite number; time that a move",
    ),
}


@pytest.mark.parametrize(("rack", "setting", "told"), MISTAKES.values(), ids=MISTAKES)
def test_a_parameter_that_no_level_has_is_a_mistake(rack: str, setting: str, told: str) -> None:
    with pytest.raises(ConfigError) as error:
        wire(load(rack, [f"board.{setting}"]))
    (mistake,) = error.value.mistakes
    assert str(mistake).startswith(f"board.{setting.partition('=')[0]} {told}")


def test_every_mistake_of_a_table_is_told(small: Path) -> None:
    with pytest.raises(ConfigError) as error:
        wire(load("nasrem", ["board.servo.params={ bandwidth = -1, damping = 9 }", "board.world.params.slow=0"]))
    assert [mistake.place for mistake in error.value.mistakes] == [
        "board.servo.params.bandwidth",
        "board.servo.params.damping",
        "board.world.params.slow",
    ]


def test_a_level_that_declares_none_reads_what_it_likes(small: Path) -> None:
    assert wire(load(small, ["board.lower.params={ gain = 'high', deep = { on = true } }"]))


@pytest.mark.parametrize("name", names())
def test_parameters_of_the_shipped_racks_are_right(name: str) -> None:
    assert wire(load(name))
