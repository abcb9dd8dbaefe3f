"""Mistakes in the host side of a config: each one line, with its place and what is permitted."""

from __future__ import annotations

import pytest

from rack.boards.config import resolve
from rack.boards.config.loader import load_text
from rack.boards.config.toml import apply_settings, parse_tables, to_toml
from rack.boards.errors import ConfigError
from tests.boards.host.test_board import HOSTED

IDLE = "rack.levels.host_program:HostProgram"
MISTAKES = {
    "a rate": (
        ["host.program.rate_hz=10"],
        "host.program.rate_hz = 10: unknown key; known: program, external, below",
    ),
    "where determinism is demanded": (
        ["protocol.strict=true"],
        (
            "host.program: a board without real time makes a run depend on timing, which"
            " protocol.strict = true refuses"
        ),
    ),
    "below": (
        ["host.program.below=brigde"],
        'host.program.below = "brigde": no board has this name; boards: bridge',
    ),
    "no bridge below": (
        ["host.program.below=[]"],
        "host.program.below: missing; port 'sum' of the host needs it",
    ),
    "real time reads the host side": (
        ["board.adder.reads.number=program.numbers"],
        (
            'board.adder.reads.number = "program.numbers": it is on the host side; pass it through'
            " a bus adapter"
        ),
    ),
    "the host side reads real time": (
        ["host.program.reads.sum=adder.status"],
        (
            'host.program.reads.sum = "adder.status": it is on the real-time side; pass it through'
            " a bus adapter"
        ),
    ),
    "a bridge on the real-time side": (
        [
            "board.second={ slot = 9, every = 1, executor = 'host_programs:Repeater', below ="
            " 'bridge' }"
        ],
        (
            'board.second.reads.sum = "bridge.sum": a bus adapter joins the two sides; '
            "'adder' and 'second' are both on the real-time side"
        ),
    ),
    "a bridge on the host side": (
        ["host.second={ program = 'host_programs:Listener', below = 'bridge' }"],
        "'program' and 'second' are both on the host side",
    ),
    "a second bridge": (
        [
            (
                "board.second={ slot = 9, every = 1, executor ="
                " 'rack.boards.host.bus_adapter:BusAdapter' }"
            ),
            "board.second.params.pass.sum={ from = 'bridge.sum' }",
        ],
        'board.second.params.pass.sum = "bridge.sum": it is already on the host side',
    ),
    "an unknown source": (
        ["board.bridge.params.pass.more={ from = 'program.more' }"],
        'board.bridge.params.pass.more = "program.more": no task writes it; mailboxes: ',
    ),
    "both modes": (
        ["board.bridge.params.pass.numbers.every=2"],
        (
            "board.bridge.params.pass.numbers: every = 2: the entry is also asynchronous; give only"
            " one of the two"
        ),
    ),
    "a phase": (
        ["board.bridge.params.pass.sum={ every = 2, phase = 2 }"],
        "board.bridge.params.pass.sum: phase = 2: must be less than every, 2",
    ),
    "a name of an entry": (
        ["board.bridge.params.pass.status={ from = 'adder.status' }"],
        "pass.status: invalid name; valid: a-z, 0-9 and _, except status, ",
    ),
    "a fault": (
        ["host.program.external=true", "fault=[{ kind = 'kill', board = 'program', tick = 1 }]"],
        'fault[0].board = "program": the rack does not start this external board',
    ),
    "a fault that needs cycles": (
        ["fault=[{ kind = 'overrun', board = 'program', tick = 1 }]", "clock.mode=realtime"],
        "overrun strikes only executors; executors: bridge, adder",
    ),
}


@pytest.mark.parametrize("name", MISTAKES)
def test_a_mistake_is_one_line(name: str) -> None:
    settings, line = MISTAKES[name]
    with pytest.raises(ConfigError) as error:
        resolve(load_text(to_toml(apply_settings(parse_tables(HOSTED), settings, []))))
    (mistake,) = error.value.mistakes
    assert line in str(mistake)


def test_a_host_board_with_a_mistake_hides_none_of_another_and_causes_none() -> None:
    other = 'program = "host_programs:Nobody"\nbelow = "bridge"'
    text = HOSTED.replace("[host.program]", "[host.program]\ncomputing_ms = -1")
    with pytest.raises(ConfigError) as caught:
        load_text(f"{text}\n[host.other]\n{other}\n")
    assert [mistake.place for mistake in caught.value.mistakes] == [
        "host.program.computing_ms",
        "host.other.program",
    ]
