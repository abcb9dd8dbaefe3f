"""Phases of boards: a static cyclic schedule on one core, what boards see across phases, and
restarts."""

from __future__ import annotations

from itertools import pairwise

import pytest

from rack.backplane.words import Block
from rack.boards import Rack
from rack.boards.config import resolve_layout
from rack.boards.config.timing import build_rack_timing
from rack.boards.timing.schedule import simulate_schedule
from tests.boards.conftest import CLOCK, MakeConfig, format_board
from tests.boards.messages import Written, run_and_read
from tests.boards.runs import faulty, kill, run_until

MINOR = {"wave": (2, 0, 1.5), "left": (4, 1, 2.2), "right": (4, 3, 2.2)}
"""A minor cycle of two ticks of 2.5 ms: the wave in the first, the watches in the second in
turn."""


def cyclic(phases: bool = True) -> str:
    """Return a static cyclic schedule of three boards on one core."""
    boards = [
        format_board(
            name,
            2 + at,
            "wave_levels:Watch" if at else "wave_levels:Wave",
            core=0,
            every=every,
            phase=phase * phases,
            below=list(MINOR)[:at][-1:],
            budget={"process_ms": process_ms},
        )
        for at, (name, (every, phase, process_ms)) in enumerate(MINOR.items())
    ]
    return f"{CLOCK}{''.join(boards)}\n[timing]\ncontext_switch_ms = 0.0\n"


@pytest.mark.thorough
def test_a_static_cyclic_schedule_runs_in_its_order_and_repeats(config: MakeConfig) -> None:
    first, again = Rack(config(text=cyclic())), Rack(config(text=cyclic()))
    found = run_and_read(first, 0.25)
    assert found.until(100) == run_and_read(again, 0.25).until(100)
    assert first.outcome is not None
    assert again.outcome is not None
    assert first.outcome.digest == again.outcome.digest
    # In lockstep a cycle ends before its deadline, not always before the next tick: the order is
    # that of the releases.
    released = sorted(
        (int(row["tick"]), name) for name, rows in found.cycles.items() for row in rows
    )
    assert released == [(tick, ("wave", "left", "wave", "right")[tick % 4]) for tick in range(100)]
    # Messages are visible by ticks, whatever the phases.
    for name, below in (("left", "wave"), ("right", "left")):
        made, seen = found.messages[f"{below}.status"], found.messages[f"{name}.status"]
        every = MINOR[below][0]
        assert made["visible_at"].tolist() == (made["tick"] + every).tolist()
        for row in seen:
            visible = made[made["visible_at"] <= row["tick"]]
            expected = visible["message"]["value"][-1] if len(visible) else 0.0
            assert row["message"]["value"] == expected


def test_the_schedule_with_phases_has_no_preemption_and_without_them_it_has(
    config: MakeConfig,
) -> None:
    def is_whole(phases: bool) -> bool:
        rack = config("board.wave.priority=2", "board.left.priority=1", text=cyclic(phases))
        chart = simulate_schedule(build_rack_timing(rack, resolve_layout(rack)).tasks, 400_000_000)
        assert not any(chart.list_late_jobs(name) for name in MINOR)
        spans = [(span.task, span.release_ns) for span in chart.spans]
        waits = any(span.start_ns > span.release_ns for span in chart.spans)
        assert all(one.end_ns <= other.start_ns for one, other in pairwise(chart.spans))
        return len(spans) == len(set(spans)) and not waits

    assert is_whole(phases=True)
    assert not is_whole(phases=False)


@pytest.mark.slow
def test_a_restart_keeps_the_phase(config: MakeConfig) -> None:
    plain = config("supervision.lockstep_restart_s=0.06", text=cyclic())
    ticks = run_and_read(Rack(faulty(plain, kill("left", 42))), 0.5).cycles["left"]["tick"].tolist()
    every, phase, _ = MINOR["left"]
    assert ticks[0] == phase
    assert {tick % every for tick in ticks} == {phase}
    steps = [later - earlier for earlier, later in pairwise(ticks)]
    assert max(steps) > 4 * every
    assert steps.count(every) == len(steps) - 1


@pytest.mark.thorough
def test_real_time_releases_each_board_on_its_phase(config: MakeConfig) -> None:
    with Rack(config("clock.mode=realtime", text=cyclic())) as rack:
        rack.start()
        blocks = [rack.segment.get_block(name) for name in MINOR]
        run_until(rack, lambda: min(block[Block.CYCLES] for block in blocks) >= 10)
        found = Written.on(rack.segment)
    for name, (every, phase, _) in MINOR.items():
        rows, block = found.cycles[name], rack.segment.get_block(name)
        assert {int(tick) % every for tick in rows["tick"]} == {phase % every}
        # What was not taken was skipped, and counted.
        last = int(rows["tick"][-1])
        assert len(rows) + block[Block.SKIPPED] == (last - phase) // every + 1
