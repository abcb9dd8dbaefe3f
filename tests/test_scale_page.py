"""The page on scale: its table and its limits follow from its constants."""

from __future__ import annotations

import re
from math import floor

import pytest

from rack.boards.config.files import CONFIGS

PAGE = (CONFIGS / "cell" / "scale.md").read_text()
RACKS, RATE_HZ, REGION, BELOW = 1000, 10.0, 50, 10


def constant(name: str) -> float:
    """Return a constant of the page."""
    (found,) = re.findall(rf"^\| {name} \| ([\d.]+) ", PAGE, re.MULTILINE)
    return float(found)


IDLE_KB, EXCHANGE_KB, LIVING_MS, EXCHANGE_MS, ADAPTER_MS = map(constant, "KEABD")
LINK_MS = LIVING_MS + ADAPTER_MS


def row(start: str) -> list[float]:
    """Return the numbers of a row of the table."""
    (found,) = re.findall(rf"^\| {start}[^|]*\|(.*)\|$", PAGE, re.MULTILINE)
    return [float(cell) for cell in found.split("|")]


def expected(connections: int, links: int, exchanging: int) -> list[float]:
    """Return a row's numbers: of the busiest rack, that has so many links and exchanges with so
    many racks."""
    traffic_kb = links * IDLE_KB + exchanging * RATE_HZ * EXCHANGE_KB
    cores = (links * LINK_MS + exchanging * RATE_HZ * EXCHANGE_MS) * 1e-3
    return [
        connections,
        links,
        round(links * IDLE_KB, 1),
        round(traffic_kb * 8e-3, 1),
        round(cores, 2),
    ]


@pytest.mark.parametrize(
    ("start", "connections", "links", "exchanging"),
    [
        ("mesh", RACKS * (RACKS - 1) // 2, RACKS - 1, RACKS - 1),
        ("star: one", RACKS - 1, RACKS - 1, RACKS - 1),
        # A link each to its router, and routers with each other.
        ("star over", RACKS + (RACKS // REGION) * (RACKS // REGION - 1) // 2, 1, RACKS - 1),
        # Those below, and the one above.
        ("tree", RACKS - 1, BELOW + 1, BELOW + 1),
    ],
)
def test_a_row_follows_from_the_constants(
    start: str, connections: int, links: int, exchanging: int
) -> None:
    assert row(start) == expected(connections, links, exchanging)


def test_the_limits_follow_from_the_constants() -> None:
    at = {rate_hz: floor(1000 / (LINK_MS + rate_hz * EXCHANGE_MS)) for rate_hz in (1, 10, 50)}
    assert f"full with {at[10]} racks at 10 Hz, and with {at[50]} at 50 Hz" in PAGE
    assert f"at 1 Hz a star takes {at[1]} racks" in PAGE
    assert f"20 ms of it last for {floor(20 / EXCHANGE_MS)} racks" in PAGE
    assert f"as much as {floor(LINK_MS / EXCHANGE_MS)} exchanges a second" in PAGE
    # 3 false deaths in 300 s of one link.
    assert f"{(RACKS - 1) * 3 / 300:.1f} a second in a star of 1,000" in PAGE
    assert f"{row('star: one')[3]} Mbit/s is a sixth of a gigabit" in PAGE
