"""Errors as users read them: one line each, whatever their value holds."""

from __future__ import annotations

import pytest

from rack.boards.errors import (
    MAX_REASON_LENGTH,
    MAX_VALUE_LENGTH,
    BoardError,
    ConfigError,
    Failure,
    LaunchError,
    Mistake,
    SnapshotError,
    format_value,
    to_one_line,
)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (True, "true"),
        (1.5, "1.5"),
        ("fast", '"fast"'),
        ((1, 2), "[1, 2]"),
        pytest.param(1 << 20000, "an integer of 20001 bits", id="huge"),
        ("a\nb\tc", '"a b c"'),
        ("bell\a", '"bell?"'),
    ],
)
def test_a_value_is_shown_as_in_a_config(value: object, text: str) -> None:
    assert format_value(value) == text


@pytest.mark.parametrize("length", [9, 10, 11, 40])
def test_a_long_text_is_cut_to_its_length(length: int) -> None:
    assert to_one_line("x" * length, 10) == ("x" * length if length <= 10 else "xxxxxxx...")


def test_a_mistake_names_place_value_and_reason() -> None:
    assert str(Mistake("clock.speed", 0, "permitted: 0.001 to 1000")) == (
        "clock.speed = 0: permitted: 0.001 to 1000"
    )
    assert str(Mistake("robot", None, "missing")) == "robot: missing"
    long = str(Mistake("p" * 500, "v" * 500, "w" * 5000))
    assert len(long) == 120 + 3 + MAX_VALUE_LENGTH + 2 + MAX_REASON_LENGTH


def test_an_error_has_each_mistake_once() -> None:
    one = Mistake("a", 1, "no")
    error = ConfigError([one, Mistake("b", 2, "no"), Mistake("a", 1, "no")])
    assert str(error) == "a = 1: no\nb = 2: no"
    assert len(error.mistakes) == 2


@pytest.mark.parametrize(
    ("error", "status"),
    [(ConfigError([]), 2), (SnapshotError("no copy"), 2), (LaunchError("not ready"), 1)],
    ids=repr,
)
def test_every_error_is_a_failure_with_the_exit_status_of_its_command(
    error: BoardError, status: int
) -> None:
    assert isinstance(error, Failure)
    assert error.status == status
