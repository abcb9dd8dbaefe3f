"""What is read from the recording of a run: plans, the bus, processor time."""

from __future__ import annotations

import pytest

from rack.boards.config import rack_timing
from rack.tools.lab.benches.systems.realtime import (
    ages_ms,
    board_loads,
    bus_traffic,
    plan_latencies,
)
from rack.tools.recording.cycles import cycles_of
from rack.tools.recording.recording import Recording
from tests.shared_runs import nasrem_run


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    return Recording(nasrem_run(tmp_path_factory))


@pytest.mark.slow
def test_a_plan_is_visible_after_as_many_cycles_as_its_planner_has(recording: Recording) -> None:
    found = {plan.maker: plan for plan in plan_latencies(recording, cycles_of(recording))}
    # Without a miss: cycles times `within_cycles`.
    latencies = {"servo": 20.0, "primitive": 40.0, "elemental_move": 1000.0, "task": 2000.0}
    for board, latency_ms in latencies.items():
        plan = found[f"{board}.planner"]
        assert plan.made > 0
        assert (plan.latency_ms["min"], plan.latency_ms["max"]) == (latency_ms, latency_ms)
        assert plan.computed_ms is not None
        assert plan.computed_ms["min"] > 0.0


@pytest.mark.slow
def test_a_board_counts_with_its_planner(recording: Recording) -> None:
    layout, ended = recording.layout, recording.ended
    ticks, tasks = ended["outcome"]["ticks"], ended["tasks"]
    found = bus_traffic(tasks, ticks, layout)
    lasted_s = ticks * layout.clock_ns * 1e-9
    assert set(found) == {"servo", "primitive", "elemental_move", "task", "world"}
    counted = [tasks[name] for name in ("servo", "servo.planner")]
    assert found["servo"].accesses * lasted_s == pytest.approx(
        sum(one["reads"] + one["writes"] for one in counted)
    )
    assert found["servo"].bytes * lasted_s == pytest.approx(
        sum(one["read_bytes"] + one["write_bytes"] for one in counted)
    )
    loads = board_loads(recording, cycles_of(recording), rack_timing(recording.rack_config, layout))
    assert set(loads) == set(found)
    assert max(loads, key=lambda board: loads[board]) == "servo"


@pytest.mark.slow
def test_commands_age_until_the_lowest_level_reads_them(recording: Recording) -> None:
    timing = rack_timing(recording.rack_config, recording.layout)
    down, up = (ages_ms(recording, timing, down=down) for down in (True, False))
    assert down is not None
    assert up is not None
    # The primitive level writes every 20 ms, and its command is read from the end of its cycle on,
    # for 20 ms.
    assert (down["min"], down["max"]) == (20.0, 37.5)
    assert (up["min"], up["max"]) == (2.5, 2.5)
