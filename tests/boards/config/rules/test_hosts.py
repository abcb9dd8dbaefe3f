"""Mistakes in the host side of a config: each one line, with its place and what is permitted."""

from __future__ import annotations

import pytest

from tests.boards.config.mistakes import find_mistake, find_mistakes
from tests.boards.host.test_board import HOSTED

PASS = "board.bridge.params.pass"
MISTAKES = [
    ("host.program.rate_hz=10", "rate_hz = 10: unknown key; known: program, external, below"),
    ("protocol.strict=true", "host.program: a board without real time makes a run depend on"),
    ("host.program.below=brigde", '.below = "brigde": no board has this name; boards: bridge'),
    ("host.program.below=[]", "host.program.below: missing; port 'sum' of the host needs it"),
    (
        "board.adder.reads.number=program.numbers",
        'board.adder.reads.number = "program.numbers": it is on the host side',
    ),
    (
        "host.program.reads.sum=adder.status",
        'host.program.reads.sum = "adder.status": it is on the real-time side',
    ),
    (
        "board.second={ slot = 9, every = 1, executor='host_programs:Repeater', below = 'bridge' }",
        "'adder' and 'second' are both on the real-time side",
    ),
    (
        "host.second={ program = 'host_programs:Listener', below = 'bridge' }",
        "'program' and 'second' are both on the host side",
    ),
    (
        "board.second={ slot = 9, every = 1, executor='rack.boards.host.bus_adapter:BusAdapter' }",
        "board.second.params.pass.sum={ from = 'bridge.sum' }",
        'board.second.params.pass.sum = "bridge.sum": it is already on the host side',
    ),
    (f"{PASS}.more={{ from = 'program.more' }}", 'pass.more = "program.more": no task writes it'),
    (f"{PASS}.numbers.every=2", "pass.numbers: every = 2: the entry is also asynchronous"),
    (f"{PASS}.sum={{ every = 2, phase = 2 }}", "pass.sum: phase = 2: must be less than every, 2"),
    (f"{PASS}.status={{ from = 'adder.status' }}", "pass.status: invalid name; valid: a-z, 0-9"),
    (
        "host.program.external=true",
        "fault=[{ kind = 'kill', board = 'program', tick = 1 }]",
        'fault[0].board = "program": the rack does not start this external board',
    ),
    (
        "fault=[{ kind = 'overrun', board = 'program', tick = 1 }]",
        "clock.mode=realtime",
        "overrun strikes only executors; executors: bridge, adder",
    ),
]
"""Settings, and what the mistake says."""


@pytest.mark.parametrize("case", MISTAKES, ids=lambda case: case[-1])
def test_a_mistake_is_one_line(case: tuple[str, ...]) -> None:
    *settings, line = case
    assert line in find_mistake(HOSTED, *settings)


def test_a_host_board_with_a_mistake_hides_none_of_another_and_causes_none() -> None:
    text = HOSTED.replace("[host.program]", "[host.program]\ncomputing_ms = -1")
    text += '\n[host.other]\nprogram = "host_programs:Nobody"\nbelow = "bridge"\n'
    places = [mistake.place for mistake in find_mistakes(text)]
    assert places == ["host.program.computing_ms", "host.other.program"]
