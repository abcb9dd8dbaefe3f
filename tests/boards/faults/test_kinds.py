"""The table of kinds: a campaign's seed draws the same faults in every version, and a config means
the same fault."""

from __future__ import annotations

from itertools import pairwise
from random import Random

import pytest

from rack.boards.faults.drawing import BEYOND, Drawing, swept
from rack.boards.faults.kind import KINDS, Kind

# Parameters: default, least, most, and the value drawn; None: none is.
KIND_TABLE: dict[str, tuple[object, ...]] = {
    "kill": ("process", None, None, "ot", (0.25, True, False), {}),
    "hang": ("process", 16, None, "t", (0.25, True, False), {}),
    "overrun": (
        "load",
        2,
        None,
        "r",
        (0.25, False, False),
        {"by": (1.5, 0.0, 100.0, 1.375), "random": (0, 0, 1, None)},
    ),
    "planner-slow": (
        "load",
        502,
        None,
        "r",
        (0.25, False, False),
        {"by": (2.0, 0.5, 100.0, 1.836)},
    ),
    "hog": ("core", 86, None, "r", (0.25, False, False), {}),
    "mute": ("writer", 16, None, "q", (0.25, False, False), {}),
    "drop": (
        "writer",
        16,
        None,
        "",
        (0.25, False, False),
        {"probability": (0.3, 0.001, 1.0, 0.5537)},
    ),
    "delay": ("writer", 26, None, "", (0.25, False, False), {"by": (2, 1, 50, 2)}),
    "reorder": (
        "writer",
        16,
        None,
        "q",
        (0.25, False, False),
        {"probability": (0.3, 0.001, 1.0, 0.5537)},
    ),
    "corrupt": (
        "writer",
        16,
        None,
        "",
        (0.25, False, False),
        {"probability": (1.0, 0.001, 1.0, 0.5672), "bits": (3, 1, 64, 3)},
    ),
    "babble": ("writer", 6, None, "q", (0.25, False, False), {"writes": (32, 3, 1000, 16)}),
    "masquerade": ("bus", None, None, "ot", (0.25, False, False), {}),
    "lock-held": ("lock", None, None, "ro", (0.25, True, False), {"killed": (0, 0, 1, 0)}),
    "clock-stop": ("clock", 33, None, "rot", (0.25, True, False), {}),
    "clock-skip": ("clock", None, None, "o", (0.25, False, False), {"ticks": (1, 1, 20, 5)}),
    "clock-jitter": (
        "clock",
        216,
        None,
        "r",
        (0.25, False, False),
        {"late": (0.9, 0.65, 0.95, 0.7769)},
    ),
    "sensor-nan": ("arm", 37, None, "", (1.0, False, True), {"joint": (0, -1, 15, 0)}),
    "sensor-stuck": ("arm", 302, None, "", (1.0, False, True), {"joint": (0, -1, 15, -1)}),
    "sensor-dropout": ("arm", 23, None, "", (1.0, False, True), {}),
    "sensor-bias": (
        "arm",
        119,
        0.02,
        "",
        (1.0, False, True),
        {"joint": (0, -1, 15, 0), "size": (0.02, 1e-05, 3.0, 0.04294)},
    ),
    "sensor-noise": (
        "arm",
        119,
        0.005,
        "",
        (1.0, False, True),
        {"joint": (0, -1, 15, 0), "size": (0.005, 1e-06, 1.0, 0.01074)},
    ),
    "actuator-off": ("arm", 56, None, "", (0.6, False, True), {"joint": (1, -1, 15, 0)}),
    "actuator-saturated": (
        "arm",
        89,
        None,
        "",
        (0.6, False, True),
        {"joint": (1, -1, 15, 0), "part": (0.1, 0.0, 0.9, 0.01275)},
    ),
    "tendon-torn": (
        "arm",
        56,
        None,
        "",
        (0.25, False, False),
        {"joint": (0, -1, 15, 0), "side": (0, 0, 1, None)},
    ),
    "command-nan": ("arm", 23, None, "", (0.25, False, False), {"joint": (0, -1, 15, 0)}),
    "command-limit": (
        "arm",
        42,
        None,
        "",
        (0.25, False, False),
        {"joint": (0, -1, 15, 0), "factor": (5.0, 1.1, 1000000.0, 13.2)},
    ),
    "self-test": ("start", None, None, "o", (0.25, False, False), {}),
}
"""Where it acts, ticks drawn, smallest size to be found, flags, recovery (s, by a restart, may
latch), parameters."""
FLAGS = {"r": "realtime", "o": "once", "t": "within_tick", "q": "not_queued"}


def drawing(seed: int = 1) -> Drawing:
    """Return a generator's draws for a task of two ticks, read every eight, at 400 Hz."""
    return Drawing(Random(seed), cycle=2, reader=8, second=400.0, joints=6)


def row(kind: Kind) -> tuple[object, ...]:
    """Return a kind as in `KIND_TABLE`."""
    d = drawing()
    parameters = {
        p.name: (p.default, p.least, p.most, p.drawn and p.drawn(d)) for p in kind.parameters
    }
    lasts = kind.lasts and kind.lasts(d)
    flags = "".join(letter for letter, name in FLAGS.items() if getattr(kind, name))
    after = kind.consequence
    recovery = (after.recovery_s, after.ends_process, after.latches)
    return kind.where, lasts, kind.visible_from, flags, recovery, parameters


@pytest.mark.parametrize("name", KIND_TABLE)
def test_a_kind_is_drawn_and_bounded_as_ever(name: str) -> None:
    assert row(KINDS[name]) == KIND_TABLE[name]


def test_every_kind_of_the_project_is_in_the_table() -> None:
    assert set(KINDS.names) == set(KIND_TABLE)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
def test_drawn_values_are_permitted_ones(kind: Kind) -> None:
    for seed in range(40):
        d = drawing(seed)
        for parameter in kind.parameters:
            if parameter.drawn is not None:
                value = parameter.drawn(d)
                assert parameter.least <= value <= parameter.most
                assert value == int(value) or not parameter.is_whole
                assert parameter is not kind.size or value >= 0.999 * (kind.visible_from or 0)
        assert kind.lasts is None or kind.lasts(d) >= 1


def test_a_sweep_is_a_geometric_series_up_to_far_beyond_what_must_be_found() -> None:
    sizes = swept(0.001, 0.02, 4)
    assert (sizes[0], sizes[-1]) == (0.001, BEYOND * 0.02)
    assert [b / a for a, b in pairwise(sizes)] == pytest.approx([400 ** (1 / 3)] * 3, rel=1e-3)
    assert swept(0.001, 0.02, 1) == [0.001]
