"""`[schedule]`: frames off the clock's grid and cycles that do not fit are refused, with the
nearest that do."""

from __future__ import annotations

import pytest

from rack.boards.config import load
from rack.boards.config.connections import Wiring
from rack.boards.config.rules.boards import check_schedule
from tests.boards.config.mistakes import find_mistake

FIT = (
    "does not fit the schedule; it must be a multiple of the minor frame, 4 ms, that divides the"
    " major frame,"
)
REFUSED = [
    ("schedule.minor_ms=4.5", "= 4.5: not a whole number of ticks of 1 ms; nearest: 4 or 5 ms"),
    ("schedule.minor_ms=0.1", "= 0.1: not a whole number of ticks of 1 ms; nearest: 1 ms"),
    ("schedule.major_ms=10", "= 10.0: not a multiple of minor_ms, 4 ms; nearest: 8 or 12 ms"),
    (
        "schedule.major_ms=40000",
        "= 40000.0: 40000 ticks are too long; the longest major frame is 10000 ticks, 10000 ms",
    ),
    (
        "board.odd.every=6",
        f"= 6: a cycle of 6 ms {FIT} 8 ms; nearest: 4 ms, every 4 or 8 ms, every 8",
    ),
    ("board.even.every=12", f"= 12: a cycle of 12 ms {FIT} 8 ms; nearest: 8 ms, every 8"),
]


@pytest.mark.parametrize(("setting", "line"), REFUSED)
def test_a_schedule_that_does_not_divide_is_one_mistake(setting: str, line: str) -> None:
    assert find_mistake("cyclic", setting) == f"{setting.partition('=')[0]} {line}"


def test_a_rate_is_refused_with_the_nearest_rates() -> None:
    rate = "board.primitive.rate_hz=57.142857142857146"
    config = load("nasrem", ["schedule={ minor_ms = 2.5, major_ms = 1000 }", rate])
    (found,) = check_schedule(Wiring(config))
    assert found.place == "board.primitive.rate_hz"
    assert found.why.startswith("a cycle of 17.5 ms does not fit the schedule")
    assert found.why.endswith("nearest: 12.5 ms, 80 Hz or 20 ms, 50 Hz")


@pytest.mark.parametrize("period_ms", [1.234567, 0.333333, 12.345678])
@pytest.mark.parametrize("minor_ms", [20.1, 98.7654])
def test_every_frame_and_rate_that_a_refusal_suggests_is_accepted_as_typed(
    period_ms: float, minor_ms: float
) -> None:
    """From mistake to mistake a user types the first value that each of them suggests."""
    settings = {"clock.period_ms": period_ms, "schedule.minor_ms": minor_ms}
    settings |= {"schedule.major_ms": 900.1, "board.primitive.rate_hz": 0.81}
    for key in ("schedule.minor_ms", "schedule.major_ms"):
        config = load("nasrem", [f"{name}={value}" for name, value in settings.items()])
        (found,) = check_schedule(Wiring(config))
        assert found.place == key
        settings[key] = float(found.why.partition("nearest: ")[2].split()[0])
    config = load("nasrem", [f"{name}={value}" for name, value in settings.items()])
    assert not any(found.place.startswith("schedule") for found in check_schedule(Wiring(config)))
