"""The response of a rack, down from its highest level and up to it: as its config promises it, and
as a run shows it.

Nothing is known of a rack in advance: levels, rates and bounds are read from its config, responses
from its messages, by what each of them rests on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from rack.boards.config import RackConfig, rack_timing, wire


@dataclass(frozen=True)
class SystemPrediction:
    """What a config promises. `levels` are those of its longest response, the highest first."""

    levels: tuple[str, ...]
    rates_hz: tuple[float, ...]


def prediction(config: RackConfig) -> SystemPrediction:
    """Return what a config promises."""
    timing = rack_timing(config, wire(config))
    hierarchy = timing.hierarchy
    rates_hz = (1e9 / (every * timing.clock_ns) for every in hierarchy.cycles)
    return SystemPrediction(hierarchy.levels, tuple(rates_hz))


@dataclass(frozen=True)
class WayResponse:
    """The response one way, ms of simulated time.

    Attributes:
        longest_ms: The longest that was measured; None if nothing went all the way.
        bound_ms: The longest on the grid.
        unexplained: Responses beyond the bound that no missed cycle delayed.
    """

    longest_ms: float | None
    bound_ms: float
    unexplained: int


@dataclass(frozen=True)
class SystemResponse:
    """The response of a rack by way, "command" and "status", next to equation 3.3, ms."""

    sum_eq_3_3_ms: float
    ways: dict[str, WayResponse]


def response_from(found: Mapping[str, Any] | None) -> SystemResponse | None:
    """Return the response in a report; None without a hierarchy, or if it crosses racks, for which
    there is no bound."""
    if found is None or found["crosses_racks"]:
        return None
    ways = {way: _way_response(found[way]) for way in ("command", "status")}
    return SystemResponse(found["sum_eq_3_3_ms"], ways)


def _way_response(way: Mapping[str, Any]) -> WayResponse:
    delays = [beyond["delayed_by"] for beyond in way["beyond"]]
    times = way["measured_ms"]
    return WayResponse(
        longest_ms=None if times is None else times["max"],
        bound_ms=way["bound_ms"],
        unexplained=sum(not any("missed" in delay for delay in each) for each in delays),
    )
