"""Racks whose boards interrupt each other: messages lost, processor time, repeated runs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import numpy as np
import pytest

from rack.backplane.words import Block
from rack.boards import Rack
from rack.boards.config import build_rack_timing, resolve_layout
from rack.boards.timing.verdicts import RESPONSE_TIME, evaluate_rack
from tests.boards.conftest import CLOCK, MakeConfig, format_board, format_figure
from tests.boards.messages import Written
from tests.boards.recording_levels import BOARDS
from tests.boards.runs import faulty, kill
from tests.machine import run_undisturbed

pytestmark = pytest.mark.slow

TICKS, SECONDS = 100, 0.25
HEAD = f'{CLOCK}\n[protocol]\ndefault = "interrupt"\n'
FIGURES = [f"figure{at}" for at in range(BOARDS)]
RACK = (
    HEAD
    + format_board("hub", 2, "recording_levels:Hub", every=1, below=FIGURES)
    + "".join(
        format_figure(name, 10 - at, 0.5, core=1 + at, every=1) for at, name in enumerate(FIGURES)
    )
)
SMALL = "protocol.interrupt.depth=2"
"""An inbox for three of five messages at once: one is served, two wait."""
OVERLOADED = "protocol.interrupt.fixed_us=900"
"""Five messages take longer than a tick."""


class Heard(NamedTuple):
    """A run: its digest, what the hub had of each board in each cycle, shape (TICKS, BOARDS), and
    its counts.

    `counts` are interrupts served and lost, and the most that waited; `full` the events of a full
    inbox. `done` are the cycles of the hub, and its releases missed and skipped; `late` the codes
    of the events about them.
    """

    digest: str
    cycle: np.ndarray
    lost: np.ndarray
    counts: tuple[int, ...]
    full: list[str]
    done: tuple[int, ...]
    late: list[str]
    service_ns: int
    written: Written


def run(
    config: MakeConfig,
    *settings: str,
    faults: Iterable[Mapping[str, Any]] = (),
    seconds: float = SECONDS,
) -> Heard:
    with Rack(faulty(config(*settings, text=RACK), *faults)) as rack:
        outcome = rack.run(seconds)
        written, block = Written.on(rack.segment), rack.segment.get_block("hub")
        heard = written.messages["hub.status"]["message"]
        served = (Block.INTERRUPTS, Block.INTERRUPTS_LOST, Block.INTERRUPTS_WAITING)
        interrupt = rack.segment.layout.find_mailbox("figure0.status").interrupt
        assert interrupt is not None
        return Heard(
            digest=outcome.digest,
            cycle=heard["cycle"],
            lost=heard["lost"],
            counts=tuple(block[word] for word in served),
            full=[event.text for event in rack.events if event.code == "inbox_full"],
            done=tuple(block[word] for word in (Block.CYCLES, Block.MISSED, Block.SKIPPED)),
            late=[event.code for event in rack.events if event.code in ("late", "starved")],
            service_ns=interrupt.service_ns,
            written=written,
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
    faults = (kill("figure4", 20), kill("hub", 31))
    quick = "supervision.lockstep_restart_s=0.02"
    first, second = (run(config, quick, *settings, faults=faults) for _ in range(2))
    assert first.digest == second.digest
    # At most as old as a full inbox is long.
    assert first.cycle[-1].max() > TICKS - 10


def test_faulty_messages_take_the_same_service_time_in_every_run(config: MakeConfig) -> None:
    begins = {"drop": 10, "delay": 25, "corrupt": 40, "reorder": 55, "babble": 70}
    faults = [
        {"kind": kind, "board": "figure3", "tick": tick, "cycles": 10}
        for kind, tick in begins.items()
    ]
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


@pytest.mark.parametrize(
    ("settings", "is_late"),
    [((), False), ((BUDGET,), False), ((LONG,), False), ((BUDGET, LONG), True)],
)
def test_handlers_take_their_time_from_the_computation_as_predicted(
    config: MakeConfig, settings: tuple[str, ...], is_late: bool
) -> None:
    first = run(config, *settings)
    rack = config(*settings, text=RACK)
    timing = build_rack_timing(rack, resolve_layout(rack))
    found = evaluate_rack(timing)
    preempted = [v for v in found if (v.equation, v.subject) == (RESPONSE_TIME, "hub")]
    assert [verdict.holds for verdict in preempted] == [not is_late] * (BUDGET in settings)
    cycles, missed, skipped = first.done
    assert bool(missed) == is_late
    assert cycles + skipped in (TICKS, TICKS - is_late)
    if is_late:
        again = run(config, *settings)
        assert (again.digest, again.done, again.late) == (first.digest, first.done, first.late)
        # The messages of the next tick come before the computation ends.
        handlers_ns = BOARDS * first.service_ns
        switches_ns = 2 * timing.context_switch_ns
        assert preempted[0].left == 1.5e6 + switches_ns + 2 * handlers_ns
        # What the handlers leave of each tick suffices for a part of a computation.
        part = (2.5e6 - handlers_ns) / 1.5e6
        assert missed == cycles == pytest.approx(part * TICKS, abs=2)
        assert first.late == ["late"]


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


HUB = {"every": 1, "below": ["quick", "slow"], "budget": {"process_ms": 0.5}}
SHARED = (
    HEAD
    + format_board("hub", 2, "recording_levels:Hub", **HUB)
    + format_figure("quick", 3, 1.2, core=1, every=1, priority=80)
    + format_figure("slow", 4, 1.6, core=1, every=4, priority=70)
)
"""The computing of 'slow' ends 4 ms after its release, in the second tick of its cycle of four."""


LOADED = ("clock.scheduler=fixed-priority", "timing.lockstep_load=1.0")
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
    rack = config(*LOADED, *settings, text=SHARED)
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
