"""Racks whose boards interrupt each other: messages lost, processor time, repeated runs."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from rack.backplane.words import Block
from rack.boards import Rack
from rack.boards.config import build_rack_timing, resolve_layout
from rack.boards.faults.config import FaultConfig
from rack.boards.timing.verdicts import RESPONSE_TIME, evaluate_rack
from tests.boards.conftest import MakeConfig
from tests.boards.interrupt_levels import BOARDS
from tests.boards.messages import Written
from tests.machine import run_undisturbed

pytestmark = pytest.mark.slow

TICKS, SECONDS = 100, 0.25
RACK = f"""
format = 2
name = "interrupted"
python_path = ["{Path(__file__).parents[1]}"]
protocol.default = "interrupt"

[clock]
period_ms = 2.5
mode = "lockstep"

[board.hub]
slot = 2
every = 1
below = [{", ".join(f'"figure{at}"' for at in range(BOARDS))}]
executor = "interrupt_levels:Hub"
""" + "".join(
    f"""
[board.figure{at}]
slot = {10 - at}
core = {1 + at}
every = 1
executor = "rack.levels.systems.figures:FigureLoop"
params.process_ms = 0.0
budget.process_ms = 0.5
"""
    for at in range(BOARDS)
)
SMALL = "protocol.interrupt.depth=2"
"""An inbox for three of five messages at once: one is served, two wait."""
OVERLOADED = "protocol.interrupt.fixed_us=900"
"""Five messages take longer than a tick."""


class Heard(NamedTuple):
    """A run: its digest, what the hub had of each board in each cycle, shape (TICKS, BOARDS), and
    its counts.

    `counts` are interrupts served and lost, and the most that waited; `full` the events of a full
    inbox.
    """

    digest: str
    cycle: np.ndarray
    lost: np.ndarray
    counts: tuple[int, int, int]
    full: list[str]
    service_ns: int
    written: Written


def run(
    config: MakeConfig,
    *settings: str,
    faults: tuple[FaultConfig, ...] = (),
    seconds: float = SECONDS,
) -> Heard:
    with Rack(config(*settings, text=RACK).model_copy(update={"fault": faults})) as rack:
        outcome = rack.run(seconds)
        written, block = Written.on(rack.segment), rack.segment.get_block("hub")
        heard = written.messages["hub.status"]["message"]
        counts = (
            block[Block.INTERRUPTS],
            block[Block.INTERRUPTS_LOST],
            block[Block.INTERRUPTS_WAITING],
        )
        full = [event.text for event in rack.events if event.code == "inbox_full"]
        interrupt = rack.segment.layout.find_mailbox("figure0.status").interrupt
        assert interrupt is not None
    return Heard(
        outcome.digest, heard["cycle"], heard["lost"], counts, full, interrupt.service_ns, written
    )


def test_every_message_arrives_in_an_inbox_with_room(config: MakeConfig) -> None:
    found = run(config)
    assert (found.cycle[1:] == np.arange(TICKS - 1)[:, None]).all()
    # What is written in the last cycle is served after it.
    assert found.counts == (BOARDS * (TICKS - 1), 0, BOARDS - 1)
    assert not found.full
    assert not found.lost.any()


def test_a_full_inbox_loses_the_messages_of_the_last_slots(config: MakeConfig) -> None:
    found = run(config, SMALL)
    # In order of the slots the last board named comes first.
    assert (found.cycle[1:, 2:] == np.arange(TICKS - 1)[:, None]).all()
    assert (found.cycle[:, :2] == -1).all()
    assert found.counts == (3 * (TICKS - 1), 2 * (TICKS - 1), 2)
    assert sorted(found.full) == [
        f"inbox is full: 1 message in 'figure{at}.status' lost" for at in (0, 1)
    ]


def test_an_overloaded_handler_delays_what_it_does_not_lose(config: MakeConfig) -> None:
    found = run(config, OVERLOADED, SMALL)
    known = found.cycle[50:]
    ages = np.arange(50, TICKS)[:, None] - known[:, known[-1] >= 0]
    assert ages.max() > 1
    served, lost, waiting = found.counts
    # Three take longer than a tick: one is still served when the next burst comes, and of that two
    # may wait.
    assert served == pytest.approx(2.5 * TICKS, abs=5)
    assert served + lost == pytest.approx(BOARDS * TICKS, abs=3 * BOARDS)
    assert waiting == 2


@pytest.mark.parametrize("settings", [(SMALL,), (OVERLOADED,)], ids=["burst", "overload"])
def test_runs_with_a_full_inbox_and_killed_boards_repeat(
    config: MakeConfig, settings: tuple[str, ...]
) -> None:
    faults = tuple(
        FaultConfig(kind="kill", board=board, tick=tick)
        for board, tick in (("figure4", 20), ("hub", 31))
    )
    quick = "supervision.lockstep_restart_s=0.02"
    first, second = (run(config, quick, *settings, faults=faults) for _ in range(2))
    assert first.digest == second.digest
    # At most as old as a full inbox is long.
    assert first.cycle[-1].max() > TICKS - 10


def test_faulty_messages_take_the_same_service_time_in_every_run(config: MakeConfig) -> None:
    faults = tuple(
        FaultConfig(kind=kind, board="figure3", tick=tick, cycles=10)  # type: ignore[arg-type]
        for kind, tick in (
            ("drop", 10),
            ("delay", 25),
            ("corrupt", 40),
            ("reorder", 55),
            ("babble", 70),
        )
    )
    first, second = (run(config, faults=faults) for _ in range(2))
    assert first.digest == second.digest
    assert first.counts == second.counts
    assert first.counts[0] != BOARDS * (TICKS - 1)
    assert first.cycle[-1, 3] == TICKS - 2


BUDGET = "board.hub.budget.process_ms=1.5"
LONG = "protocol.interrupt.fixed_us=300"
"""Five messages that come during a computation of 1.5 ms make it longer than a tick."""


FIRST = (
    "clock.priority=90",
    "board.hub.priority=50",
    *(f"board.figure{at}.priority={60 + at}" for at in range(BOARDS)),
)
"""Settings with which ordinary processes do not delay boards, where real time is permitted."""


class Cycles(NamedTuple):
    """What a run of the hub has done: missed and skipped releases, and its late events."""

    digest: str
    cycles: int
    missed: int
    skipped: int
    late: tuple[str, ...]


def cycle(config: MakeConfig, *settings: str) -> Cycles:
    with Rack(config(*settings, text=RACK)) as rack:
        outcome = rack.run(SECONDS)
        block = rack.segment.get_block("hub")
        late = tuple(event.code for event in rack.events if event.code in ("late", "starved"))
        counts = (block[word] for word in (Block.CYCLES, Block.MISSED, Block.SKIPPED))
        return Cycles(outcome.digest, *counts, late)


@pytest.mark.parametrize(
    ("settings", "is_late"),
    [((), False), ((BUDGET,), False), ((LONG,), False), ((BUDGET, LONG), True)],
)
def test_handlers_take_their_time_from_the_computation_as_predicted(
    config: MakeConfig, settings: tuple[str, ...], is_late: bool
) -> None:
    first = cycle(config, *settings)
    rack = config(*settings, text=RACK)
    found = evaluate_rack(build_rack_timing(rack, resolve_layout(rack)))
    preempted = [v for v in found if (v.equation, v.subject) == (RESPONSE_TIME, "hub")]
    assert [verdict.holds for verdict in preempted] == [not is_late] * (BUDGET in settings)
    assert bool(first.missed) == is_late
    assert first.cycles + first.skipped in (TICKS, TICKS - is_late)
    if is_late:
        assert cycle(config, *settings) == first
        interrupt = resolve_layout(rack).find_mailbox("figure0.status").interrupt
        assert interrupt is not None
        # The messages of the next tick come before the computation ends.
        handlers_ns = BOARDS * interrupt.service_ns
        timing = build_rack_timing(rack, resolve_layout(rack))
        switches_ns = 2 * timing.context_switch_ns
        assert preempted[0].left == 1.5e6 + switches_ns + 2 * handlers_ns
        # What the handlers leave of each tick suffices for a part of a computation.
        part = (2.5e6 - handlers_ns) / 1.5e6
        assert first.missed == first.cycles == pytest.approx(part * TICKS, abs=2)
        assert first.late == ("late",)


def test_a_message_that_comes_between_computations_takes_no_time(config: MakeConfig) -> None:
    # Sent 0.5 ms after the release, when the hub has finished.
    rack = config("board.hub.budget.process_ms=0.4", LONG, text=RACK)
    timing = build_rack_timing(rack, resolve_layout(rack))
    assert timing.compute_interrupted_ns("hub") == 0
    longer = config("board.hub.budget.process_ms=0.6", LONG, text=RACK)
    assert build_rack_timing(longer, resolve_layout(longer)).compute_interrupted_ns("hub") > 1.5e6


def in_time(found: Heard) -> np.ndarray:
    """Return the cycles of the hub that began at once and whose messages came meanwhile."""
    cycles = found.written.cycles["hub"]
    is_in_time = cycles["start_ns"] - cycles["release_ns"] < 1_000_000
    for at in range(BOARDS):
        rows = found.written.cycles[f"figure{at}"]
        ticks = rows["tick"][rows["end_ns"] - rows["release_ns"] < 3_500_000]
        is_in_time &= np.isin(cycles["tick"], ticks)
    return cycles[is_in_time]


@pytest.mark.thorough
def test_in_real_time_interrupts_take_the_time_of_the_computation(config: MakeConfig) -> None:
    slow = "clock.speed=0.25"  # a tick lasts 10 ms, so messages come 2 ms after the release
    settings = ("clock.mode=realtime", slow, LONG, "board.hub.params.compute_ns=4000000", *FIRST)

    def find_disturbance(found: Heard) -> str:
        count = len(in_time(found))
        return "" if count > 20 else f"only {count} cycles of all boards were in time"

    found = run_undisturbed(lambda: run(config, *settings, seconds=0.15), find_disturbance)
    cycles = in_time(found)
    computing_ns = cycles["process_ns"] - cycles["read_ns"]
    assert np.median(computing_ns) >= 4e6 + BOARDS * found.service_ns
    brief = run(config, "clock.mode=realtime", slow, LONG, *FIRST, seconds=0.1)
    cycles = brief.written.cycles["hub"]
    # A cycle that began in time was over when the messages came.
    assert (cycles["process_ns"] - cycles["read_ns"]).min() < brief.service_ns
    written = sum(len(brief.written.messages[f"figure{at}.status"]) for at in range(BOARDS))
    served, lost, _ = brief.counts
    assert written - 3 * BOARDS <= served + lost <= written


SHARED = f"""
format = 2
name = "shared"
python_path = ["{Path(__file__).parents[1]}"]
protocol.default = "interrupt"

[clock]
period_ms = 2.5
mode = "lockstep"
scheduler = "fixed-priority"

[timing]
lockstep_load = 1.0

[board.hub]
slot = 2
every = 1
below = ["quick", "slow"]
executor = "interrupt_levels:Hub"
budget.process_ms = 0.5

[board.quick]
slot = 3
core = 1
every = 1
priority = 80
executor = "rack.levels.systems.figures:FigureLoop"
params.process_ms = 0.0
budget.process_ms = 1.2

[board.slow]
slot = 4
core = 1
every = 4
priority = 70
executor = "rack.levels.systems.figures:FigureLoop"
params.process_ms = 0.0
budget.process_ms = 1.6
"""
"""The computing of 'slow' ends 4 ms after its release, in the second tick of its cycle of four."""


EXACT = "timing.context_switch_ms=0"
"""As in lockstep, where context switches take no time."""


@pytest.mark.parametrize(
    ("settings", "due", "is_late"),
    [
        ((), 2, False),
        (("board.slow.budget.send_within_ms=2.5",), 1, True),
        (("board.slow.budget.send_within_ms=5",), 2, False),
        (("board.quick.budget.process_ms=0.4",), 1, False),
        (("board.slow.budget={ process_ms = 1.3, send_within_ms = 2.5 }", EXACT), 1, False),
    ],
    ids=["the response", "too early", "room", "less before it", "just in time"],
)
def test_a_message_is_sent_after_the_response_of_its_writer(
    config: MakeConfig, settings: tuple[str, ...], due: int, is_late: bool
) -> None:
    rack = config(*settings, text=SHARED)
    layout = resolve_layout(rack)
    assert layout.compute_due_ticks(layout.find_task("slow")) == due
    found = evaluate_rack(build_rack_timing(rack, layout))
    assert [v.subject for v in found if not v.holds] == ["slow"] * is_late
    with Rack(rack) as crate:
        crate.run(SECONDS)
        counts = {
            name: (block[Block.MISSED], block[Block.SKIPPED])
            for name in ("hub", "quick", "slow")
            for block in [crate.segment.get_block(name)]
        }
    assert counts == {"hub": (0, 0), "quick": (0, 0), "slow": (TICKS // 4 * is_late, 0)}
