"""Signals and conditions in the form in which users write them."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
import pytest

from rack.backplane.layout import MailboxSpec
from rack.backplane.message import Message, field
from rack.boards.config.layout import build_field_specs
from rack.tools.recording.signal import Signal, Trigger
from tests.tools.command_line import read_failure


class Gait(IntEnum):
    """States of the walker."""

    STANDS = 0
    WALKS = 1


class Leg(Message, version=1):
    angle: np.ndarray = field(unit="rad", doc="of hip and knee", shape=2)


class Walker(Message, version=1):
    gait: Gait = field(doc="what it does")
    speed: float = field(unit="m/s", doc="forwards")
    name: str = field("S8", doc="its name")
    legs: np.ndarray = field(Leg, doc="left and right", shape=2)


DTYPE = Walker.message_type.build_dtype({})
BOX = MailboxSpec(
    name="walker.status",
    writer="walker",
    readers=(),
    protocol="time-slice",
    every=1,
    delay=1,
    depth=8,
    message=Walker.message_type.name,
    version=1,
    size=DTYPE.itemsize,
    fields=build_field_specs(Walker.message_type, {}),
)


@pytest.fixture
def messages() -> np.ndarray:
    """Three messages of a walker that starts, then falls."""
    found = np.zeros(3, DTYPE)
    found["gait"] = [0, 1, 1]
    found["speed"] = [0.0, 1.5, np.nan]
    found["name"] = b"ada"
    found["legs"]["angle"] = np.arange(12.0).reshape(3, 2, 2)
    return found


@pytest.mark.parametrize(
    ("name", "values"),
    [
        ("speed", [0.0, 1.5, None]),
        ("gait", ["stands", "walks", "walks"]),
        ("name", ["ada"] * 3),
        ("legs.angle", [[[0, 1], [2, 3]], [[4, 5], [6, 7]], [[8, 9], [10, 11]]]),
        ("legs.angle[1]", [[2, 3], [6, 7], [10, 11]]),
        ("legs.angle[1][0]", [2, 6, 10]),
    ],
)
def test_a_signal_is_a_field_or_a_part_of_it(
    messages: np.ndarray, name: str, values: list[object]
) -> None:
    signal = Signal.parse(f"walker.status.{name}", [BOX])
    assert signal.extract_plain(messages) == values
    assert signal.extract_plain(messages[:0]) == []


def test_a_text_is_shown_with_escapes_in_place_of_control_characters(messages: np.ndarray) -> None:
    signal = Signal.parse("walker.status.name", [BOX])
    messages["name"] = b"\x1b[2J\xe9"
    shown = "\\x1b[2J\N{REPLACEMENT CHARACTER}"
    assert signal.extract_plain(messages) == [shown] * 3
    assert signal.read_message(messages[0]) == shown


UNKNOWN = {
    "walker.status.sped": "no such signal; nearest: walker.status.speed",
    "xyz": "no such signal; mailboxes: walker.status",
    "walker.status.speed]": "no such signal; nearest: walker.status.speed",
    "walker.status.legs.angle[2]": (
        "no such index; valid: walker.status.legs.angle[0 to 1][0 to 1]"
    ),
    "walker.status.speed[0]": "no such index; valid: walker.status.speed",
}


@pytest.mark.parametrize(("name", "why"), UNKNOWN.items())
def test_an_unknown_name_is_reported_in_one_line(name: str, why: str) -> None:
    assert read_failure(Signal.parse, name, [BOX]).startswith(f"{name}: {why}")


@pytest.mark.parametrize(
    ("text", "holds"),
    [
        ("walker.status.speed > 1", [False, True, False]),
        ("walker.status.speed>=1.5", [False, True, False]),
        ("walker.status.speed < 1.5", [True, False, False]),
        ("walker.status.speed <= 1.5", [True, True, False]),
        ("walker.status.gait == walks", [False, True, True]),
        ("walker.status.gait != 1", [True, False, False]),
        ("walker.status.legs.angle[0][1] == 5", [False, True, False]),
    ],
)
def test_a_condition_compares_a_number(messages: np.ndarray, text: str, holds: list[bool]) -> None:
    assert Trigger.parse(text, [BOX]).evaluate_messages(messages).tolist() == holds


UNFIT = {
    "walker.status.speed": (
        '"{}" is not a condition; write one like "servo.status.position[2] > 1.2"'
    ),
    "walker.status.legs.angle[0] > 1": (
        "walker.status.legs.angle[0] is numbers of shape [2]; a condition needs a single number"
    ),
    "walker.status.name == 1": "walker.status.name is text; a condition needs a single number",
    "walker.status.speed > x": '"{}": x is not a number',
    "walker.status.gait == runs": '"{}": runs is not a number or one of stands, walks',
}


@pytest.mark.parametrize(("text", "why"), UNFIT.items())
def test_an_invalid_condition_is_reported_in_one_line(text: str, why: str) -> None:
    assert read_failure(Trigger.parse, text, [BOX]) == why.format(text)
