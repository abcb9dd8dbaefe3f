"""Determinism: lockstep is repeatable, and real time is lockstep up to its first miss."""

from __future__ import annotations

from typing import get_args

import numpy as np
import pytest

from rack.backplane.layout import PROTOCOLS, Protocol, Wake
from rack.backplane.trace import Flag
from rack.backplane.words import Block, System
from rack.boards import Rack
from tests.boards.conftest import LOOSE, PLAIN, PLANNED, MakeConfig
from tests.boards.messages import Written, run_and_read
from tests.machine import needs_two_cores

SECONDS = 0.25
TICKS = 100
SLOW = ("clock.mode=realtime", "clock.speed=0.5")
"""Real time with room: on a machine that does other work too, most cycles are in time."""

OUTLASTING = "board.wave.params={ trouble = 'outlast', at = 40, ticks = 4 }"
"""Setting with which the wave computes until the clock has given it four more releases: by time
alone it would have had fewer from a late clock."""


RUNS: dict[tuple[str, ...], tuple[Rack, Written]] = {}


def first_run(
    config: MakeConfig, *settings: str, text: str = PLANNED, seconds: float = SECONDS
) -> tuple[Rack, Written]:
    """Return a rack that has run, and what it wrote; all tests of the process share it."""
    key = (*settings, text)
    if key not in RUNS:
        rack = Rack(config(*settings, text=text))
        RUNS[key] = rack, run_and_read(rack, seconds)
    return RUNS[key]


def digest(rack: Rack) -> str:
    """Return the digest of a rack, which runs if it has not yet."""
    if rack.outcome is None:
        with rack:
            rack.run(SECONDS)
    assert rack.outcome is not None
    return rack.outcome.digest


@pytest.mark.slow
def test_the_digest_distinguishes_runs(config: MakeConfig) -> None:
    settings = ("board.wave.params.done_at=90", "board.wave.within_cycles=5")
    digests = {digest(Rack(config(one))) for one in settings}
    assert len(digests | {digest(first_run(config)[0])}) == 1 + len(settings)


@pytest.mark.slow
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_every_protocol_is_repeatable_in_lockstep(config: MakeConfig, protocol: Protocol) -> None:
    rack = Rack(config(f"protocol.default={protocol}"))
    again = () if protocol == "time-slice" else (f"protocol.default={protocol}",)
    assert digest(rack) == digest(first_run(config, *again)[0])
    assert counted(rack, Block.CORRUPT, Block.BUS_ERRORS, Block.MISSED, Block.SKIPPED) == 0


@pytest.mark.slow
def test_a_single_mailbox_may_have_a_different_protocol(config: MakeConfig) -> None:
    shared = "protocol.mailbox={ 'wave.plan' = 'double-buffer' }"
    time_slice = first_run(config)[1]
    mixed, again = (run_and_read(Rack(config(shared)), SECONDS) for _ in range(2))
    assert mixed.until(TICKS) == again.until(TICKS)
    assert mixed.messages["wave.plan"]["visible_at"][0] == 0
    assert time_slice.messages["wave.plan"]["visible_at"][0] == 4
    assert mixed.messages["wave.status"]["visible_at"][0] == 1


def test_under_time_slice_a_level_reads_by_ticks_alone(config: MakeConfig) -> None:
    _, found = first_run(config, text=PLAIN)
    seen, made = found.messages["watch.status"], found.messages["wave.status"]
    assert seen["tick"].tolist() == list(range(0, TICKS, 8))
    # The wave's message of the tick before; none at tick 0.
    expected = [0.0, *(made["message"]["value"][tick - 1] for tick in range(8, TICKS, 8))]
    assert seen["message"]["value"].tolist() == expected
    assert seen["basis"].tolist() == [0, *(tick - 1 for tick in range(8, TICKS, 8))]


@pytest.mark.slow
@pytest.mark.parametrize("coupling", [(), LOOSE], ids=["tight", "loose"])
def test_real_time_is_lockstep_up_to_its_first_miss(
    config: MakeConfig, coupling: tuple[str, ...]
) -> None:
    exact, lockstep = first_run(config, *coupling)
    for _ in range(2):
        rack = Rack(config(*SLOW, *coupling))
        realtime = run_and_read(rack, SECONDS)
        same = realtime.first_miss(TICKS)
        assert realtime.until(same) == lockstep.until(same)
        if same == TICKS:
            assert digest(rack) == digest(exact)
            return
        assert (
            rack.segment.words[System.CLOCK_SKIPPED] + counted(rack, Block.MISSED, Block.SKIPPED)
            > 0
        )


def counted(rack: Rack, *words: int) -> int:
    """Return the sum of these words over all tasks."""
    return sum(
        rack.segment.get_block(task.name)[word]
        for task in rack.segment.layout.tasks
        for word in words
    )


def late_tick(found: Written, task: str) -> int:
    """Return the tick of the late cycle: the first from tick 40 on that was not skipped."""
    ticks = found.cycles[task]["tick"]
    return int(ticks[ticks >= 40][0])


@pytest.mark.slow
def test_a_late_cycle_is_counted_and_the_board_rejoins_the_grid(config: MakeConfig) -> None:
    rack, found = first_run(config, *SLOW, OUTLASTING, text=PLAIN, seconds=2 * SECONDS)
    cycles, words = found.cycles["wave"], rack.segment.words
    ticks = cycles["tick"]
    late = late_tick(found, "wave")
    at = ticks.tolist().index(late)
    assert cycles["flags"][at] & Flag.MISSED
    # Of the four releases that it missed it takes the newest.
    assert ticks[at + 1] >= late + 4
    assert cycles["flags"][at + 1] & Flag.SKIPPED
    block = rack.segment.get_block("wave")
    assert block[Block.SKIPPED] == np.sum(np.diff(ticks) - 1) + ticks[0]
    assert block[Block.MISSED] == np.count_nonzero(cycles["flags"] & Flag.MISSED)
    assert (cycles["release_ns"] == words[System.EPOCH_NS] + ticks * words[System.PERIOD_NS]).all()
    # Its message shows from the next boundary, and up to it the run is that of lockstep.
    messages = found.messages["wave.status"]
    assert messages[messages["tick"] == late]["visible_at"][0] >= late + 5
    behind = messages[messages["tick"] > late]
    assert len(behind)
    assert (behind["visible_at"] > behind["tick"]).all()
    same, lockstep = found.first_miss(TICKS), first_run(config, text=PLAIN)[1]
    assert same <= 40
    assert found.until(same) == lockstep.until(same)
    assert found.until(TICKS) != lockstep.until(TICKS)


@pytest.mark.slow
@pytest.mark.alone
def test_a_late_plan_is_counted_and_shows_later(config: MakeConfig) -> None:
    late = "board.wave.params={ trouble = 'late', at = 40, ticks = 20 }"
    rack = Rack(config(*SLOW, *LOOSE, "board.wave.executor=wave_levels:Steady", late))
    found = run_and_read(rack, SECONDS)
    plans, cycles = found.messages["wave.plan"], found.cycles["wave.planner"]
    tick = late_tick(found, "wave.planner")
    flags = cycles[cycles["tick"] == tick]["flags"][0]
    assert flags & Flag.MISSED
    assert flags & Flag.PLANNED
    assert plans[plans["tick"] == tick]["visible_at"][0] > tick + 4
    assert rack.segment.get_block("wave.planner")[Block.MISSED] >= 1
    assert rack.segment.get_block("wave.planner")[Block.PLANS] == len(plans)


@pytest.mark.slow
def test_a_slow_cycle_changes_nothing_in_lockstep(config: MakeConfig) -> None:
    quiet, _ = first_run(config, text=PLAIN)
    slow = Rack(config("board.wave.params={ trouble='late', at=40, ticks=9 }", text=PLAIN))
    assert digest(slow) == digest(quiet)
    assert counted(slow, Block.MISSED, Block.SKIPPED) == 0


@needs_two_cores
@pytest.mark.slow
def test_boards_write_the_same_however_they_wait(config: MakeConfig) -> None:
    racks = [Rack(config(f"board.wave.wake={wake}", text=PLAIN)) for wake in get_args(Wake)]
    assert len({digest(rack) for rack in racks}) == 1


@needs_two_cores
@pytest.mark.slow
@pytest.mark.parametrize("wake", get_args(Wake))
def test_a_board_keeps_the_grid_in_real_time(config: MakeConfig, wake: Wake) -> None:
    with Rack(config(f"board.wave.wake={wake}", *SLOW, text=PLAIN)) as rack:
        assert rack.run(SECONDS).ticks == TICKS
        block = rack.segment.get_block("wave")
        cycles = Written.on(rack.segment).cycles["wave"]
        # A board whose core was taken away during the very last cycles does not see those any more.
        assert block[Block.CYCLES] + block[Block.SKIPPED] == cycles["tick"][-1] + 1 <= TICKS
    assert (cycles["start_ns"] >= cycles["release_ns"]).all()
