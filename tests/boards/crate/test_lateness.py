"""A level that loses too many of its cycles fails the run; a release without a cycle is a skipped
cycle, whatever the reason."""

from __future__ import annotations

import pytest

from rack.backplane.words import Block
from rack.boards import Rack
from rack.boards.config.schema import RackConfig
from rack.boards.crate.lateness import _count_permitted
from rack.boards.events import Event, Outcome
from tests.boards.conftest import LOOSE, PLAIN, MakeConfig
from tests.boards.runs import faulty, kill

JUDGED = "supervision.max_missed_fraction=0.05"
SOON = "supervision.lockstep_restart_s=0.05"
"""A lost board is back after 20 ticks."""
CRASHES = ('board.wave.params.trouble="crash"', "supervision.restarts=1000")
COUNTED = tuple[int, int, int, int]  # cycles, missed, skipped, due


def run(config: RackConfig, seconds: float) -> tuple[Outcome, list[Event], dict[str, COUNTED]]:
    """Run a rack; return how it ended, what happened, and the counts of its tasks."""
    with Rack(config) as rack:
        outcome = rack.run(seconds)
        counted = {
            task.name: (
                rack.segment.get_block(task.name)[Block.CYCLES],
                *rack.segment.count_cycles(task, outcome.ticks)[:3],
            )
            for task in rack.segment.layout.tasks
        }
        return outcome, rack.events, counted


@pytest.mark.parametrize(
    ("due", "fraction", "plan", "permitted"),
    [
        (800, 0.05, 1, 40),
        (10, 0.05, 1, 1),
        (1, 0.05, 1, 0),
        (100, 0.0, 1, 0),
        (10, 0.99, 1, 9),
        (400, 0.05, 8, 24),
        (4, 0.05, 4, 3),
    ],
)
def test_the_permitted_fraction_is_rounded_up_but_never_permits_losing_every_cycle(
    due: int, fraction: float, plan: int, permitted: int
) -> None:
    assert _count_permitted(due, fraction, plan) == permitted


@pytest.mark.slow
def test_a_level_that_crashes_in_every_first_cycle_has_skipped_all_and_fails_the_run(
    config: MakeConfig,
) -> None:
    outcome, events, counted = run(config(JUDGED, SOON, *CRASHES, text=PLAIN), 0.2)
    assert counted == {"wave": (0, 0, 80, 80), "watch": (10, 0, 0, 10)}
    assert (outcome.cause, outcome.is_success) == ("time over", False)
    assert outcome.faults == (
        "level 'wave' missed 0 and skipped 80 of its 80 cycles (100 %; at most 5 % permitted)",
    )
    printed = [event.text for event in events if event.kind == "printed"]
    died = sum(event.kind == "died" for event in events)
    # The last one may not have been read.
    assert died - printed.count("RuntimeError: no cycle at all") in (0, 1)


@pytest.mark.slow
@pytest.mark.parametrize("coupling", [(), LOOSE], ids=["tight", "loose"])
def test_every_release_of_an_executor_is_a_cycle_or_a_skipped_one(
    config: MakeConfig, coupling: tuple[str, ...]
) -> None:
    # The last board is not back before the end of the run.
    faults = [
        kill("wave", 30),
        kill("wave", 60),
        {"kind": "clock-skip", "board": "clock", "tick": 100, "ticks": 7},
        kill("watch", 150),
    ]
    _, _, counted = run(faulty(config(JUDGED, SOON, *coupling), *faults), 0.4)
    for name in ("wave", "watch"):
        cycles, missed, skipped, due = counted[name]
        assert (cycles + skipped, missed) == (due, 0), name
    assert counted["wave"][2] == 20 + 20 + 7
    assert counted["watch"][2] == 1


@pytest.mark.slow
def test_lost_cycles_are_excused_by_an_injected_fault_as_far_as_it_can_have_cost_them(
    config: MakeConfig,
) -> None:
    struck = kill("wave", 80)
    outcome, _, counted = run(faulty(config(JUDGED, SOON, text=PLAIN), struck), 0.8)
    assert (outcome.is_success, counted["wave"]) == (True, (300, 0, 20, 320))
    # Its tick, one cycle, 20 ticks for the restart, and 100 for the recovery.
    named = "122 of which were due during faults and recoveries: kill of wave"
    assert outcome.excused == (f"level 'wave' missed 0 and skipped 20 of its 320 cycles, {named}",)
    # What else is lost is not excused.
    struck["board"] = "watch"
    named = "129 of which were due during faults and recoveries: kill of watch"
    outcome, _, _ = run(faulty(config(JUDGED, SOON, *CRASHES, text=PLAIN), struck), 0.8)
    assert outcome.faults == (
        f"level 'wave' missed 0 and skipped 320 of its 320 cycles, {named}"
        " (100 %; at most 5 % permitted)",
    )


@pytest.mark.slow
@pytest.mark.parametrize(("fraction", "worked"), [(0.05, False), (0.15, True)])
def test_a_board_that_dies_by_itself_is_not_excused(
    config: MakeConfig, fraction: float, worked: bool
) -> None:
    settings = (f"supervision.max_missed_fraction={fraction}", SOON)
    dies = ('board.wave.params.trouble="die"', "board.wave.params.at=100")
    outcome, _, counted = run(config(*settings, *dies, text=PLAIN), 0.4)
    assert counted["wave"] == (140, 0, 20, 160)
    assert outcome.is_success is worked
    assert outcome.excused == ()


@pytest.mark.slow
def test_a_planner_is_judged_by_its_releases_of_which_a_plan_takes_several(
    config: MakeConfig,
) -> None:
    outcome, _, counted = run(config(JUDGED), 0.5)
    assert outcome.is_success
    assert counted["wave.planner"][1:] == (0, 0, 197)
