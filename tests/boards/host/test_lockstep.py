"""Programs of host boards in lockstep: the rack waits until they wait, so that runs repeat, and
never for ever."""

from __future__ import annotations

import os
import signal
import time

import pytest

from rack.backplane.words import Block
from rack.boards import Rack
from rack.boards.host.bus_adapter import LONGEST_S
from rack.tools.faults.ending import list_strikes
from tests.boards.conftest import MakeConfig, format_board
from tests.boards.host.test_board import BUS_ADAPTER, ENDS, HOSTED, codes, hosted, status
from tests.boards.runs import stop, watch_until
from tests.processes import wait_until

pytestmark = pytest.mark.thorough

PASS = {"pass": {"sum": {"from": "adder.status", "every": 2}}}
SECOND = HOSTED + format_board("second", 4, BUS_ADAPTER, rate_hz=80, phase=1, params=PASS)
"""The program reads through a second bridge, too."""
SLOW = "host.program.program=host_programs:Slow"
SOON = "supervision.lockstep_restart_s=0.1"
STRUCK = "{ kind='kill', board='program', at=0.15 }, { kind='kill', board='bridge', at=0.35 }"


def slow(config: MakeConfig, lag: float, *settings: str) -> str:
    """Return the digest of a run with a program that takes up to `lag` seconds for each number."""
    lines = (SLOW, f"host.program.params.lag={lag}", SOON, *settings)
    with Rack(config(*lines, text=SECOND)) as rack:
        outcome = rack.run()
        assert (outcome.cause, outcome.faults) == ("task done", ())
        assert status(rack.segment, "adder").last == 40
    return outcome.digest


@pytest.mark.parametrize(
    "settings",
    [
        (),
        ("host.program.computing_ms=35",),
        (f"fault=[{STRUCK}]",),
        ("fault=[{ kind='hang', board='program', at=0.15 }]",),
    ],
    ids=["alone", "computing", "killed", "stopped"],
)
def test_a_run_repeats_however_long_its_program_takes(
    config: MakeConfig, settings: tuple[str, ...]
) -> None:
    assert slow(config, 0.0, *settings) == slow(config, 0.03, *settings)


def test_a_fault_does_not_strike_a_finished_program_whose_process_still_exists(
    config: MakeConfig,
) -> None:
    struck = "fault=[{ kind='kill', board='program', at=0.2 }]"
    with Rack(hosted(config, "Lingering", struck, "board.bridge.ends_run=false")) as rack:
        assert rack.run(0.5).cause == "time over"
        assert [strike.tick for strike in list_strikes(rack.segment, ())] == [-1]


def test_a_program_that_does_not_wait_ends_the_run_with_that_reason(config: MakeConfig) -> None:
    hasty = "board.bridge.executor=host_programs:HastyAdapter"
    with Rack(hosted(config, "Deaf", hasty)) as rack:
        outcome = rack.run()
    assert (outcome.cause, outcome.is_success) == ("board lost", False)
    (fault,) = outcome.faults
    assert fault.startswith(
        "board 'bridge': the program of host board 'program' has not waited for 1 s of real time,"
        " and lockstep cannot continue"
    )


def test_a_stop_ends_the_wait_for_a_program(config: MakeConfig) -> None:
    with Rack(hosted(config, "Silent")) as rack:
        rack.start()
        block = rack.segment.get_block("program")
        wait_until(lambda: rack.watch(0.01) and block[Block.PID] and block[Block.RELEASED] >= 0)
        began = time.monotonic()
        assert stop(rack).cause == "stopped"
    assert time.monotonic() - began < LONGEST_S / 2


def test_a_program_that_stops_while_the_rack_waits_for_it_does_not_hold_the_rack(
    config: MakeConfig,
) -> None:
    with Rack(hosted(config, "Silent")) as rack:
        rack.start()
        block = rack.segment.get_block("program")
        wait_until(lambda: rack.watch(0.01) and block[Block.PID] and block[Block.RELEASED] >= 0)
        os.kill(block[Block.PID], signal.SIGSTOP)
        watch_until(rack, lambda: "rejoined" in codes(rack, "program"))
        stop(rack)
    assert [code for code in codes(rack, "program") if code in ENDS] == [
        "died",
        "restart",
        "rejoined",
    ]
    said = [event.text for event in rack.events]
    assert said.count("'program' is not responding: stopped by a signal") == 1


def test_a_program_that_is_given_up_ends_the_run_at_the_same_tick(config: MakeConfig) -> None:
    found = []
    for _ in range(2):
        with Rack(hosted(config, "Failing", "host.program.restarts=2")) as rack:
            outcome = rack.run()
            found.append((outcome.cause, outcome.ticks, outcome.digest))
    assert found[0] == found[1]
    assert found[0][0] == "task failed"
