"""Times from a trace: those of a cycle and its parts, plan ages, and the occupation of a core."""

from __future__ import annotations

import numpy as np

from rack.backplane.trace import RECORD, SKIPPED_SHIFT, Flag
from rack.boards.timing import trace_times
from rack.boards.timing.trace_times import Occupation, compute_plan_ages
from rack.tools.timing.charts.measured import compute_waking_ns


def test_a_plan_ages_until_the_next_one_can_be_read() -> None:
    executor, made, visible_at = np.arange(20), np.array([0, 8]), np.array([4, 12])
    # Plan 0 is read in ticks 4 to 11, plan 8 in 12 to 19.
    assert compute_plan_ages(executor, made, visible_at).tolist() == [*range(4, 12), *range(4, 12)]
    # A late plan is not visible before its own tick.
    made, visible_at = np.array([0, 4, 8]), np.array([4, 15, 12])
    ages = compute_plan_ages(np.array([3, 11, 12, 14, 15]), made, visible_at)
    assert ages.tolist() == [11, 12, 14, 7]


def test_occupied_time_within_a_stretch_equals_a_count_of_moments() -> None:
    random = np.random.default_rng(3)
    for _ in range(200):
        starts = random.integers(0, 60, random.integers(0, 12))
        ends = starts + random.integers(0, 12, len(starts))
        occupied = {t for start, end in zip(starts, ends, strict=True) for t in range(start, end)}
        asked = np.sort(random.integers(-5, 80, (9, 2)), axis=1)
        found = Occupation(starts, ends).compute_overlap(asked[:, 0], asked[:, 1])
        assert found.tolist() == [len(occupied & set(range(start, end))) for start, end in asked]


def records(*cycles: dict[str, int]) -> np.ndarray:
    """Return a record of each cycle; a field that is not given is 0."""
    rows = np.zeros(len(cycles), RECORD)
    for row, cycle in zip(rows, cycles, strict=True):
        for name, value in cycle.items():
            row[name] = value
    return rows


def cycle(release: int, parts: tuple[int, int, int, int], processor: int) -> dict[str, int]:
    """Return a cycle that starts 10 ns after its release and has parts of these lengths."""
    stamps = np.cumsum([release + 10, *parts]).tolist()
    times = dict(zip(trace_times.STAMPS, stamps, strict=True))
    return {"release_ns": release, "processor_ns": processor, **times}


USUAL = (10, 20, 40, 30)


def test_the_times_of_a_cycle_lie_between_its_stamps() -> None:
    rows = records(cycle(1000, USUAL, 104), cycle(3000, (1, 2, 4, 8), 0))
    assert trace_times.compute_lateness_ns(rows).tolist() == [10, 10]
    assert trace_times.compute_response_ns(rows).tolist() == [110, 25]
    assert trace_times.compute_duration_ns(rows).tolist() == [100, 15]
    assert trace_times.compute_execution_ns(rows).tolist() == [40, 4]
    assert trace_times.compute_communication_ns(rows).tolist() == [60, 11]
    assert (100 - trace_times.compute_response_ns(rows)).tolist() == [-10, 75]
    assert trace_times.compute_gaps_ns(rows).tolist() == [2000]


def test_flags_say_which_cycles_missed_skipped_or_planned() -> None:
    skips = 3 << SKIPPED_SHIFT
    flags = (0, Flag.MISSED, Flag.PLANNED, Flag.SKIPPED | skips, Flag.MISSED | Flag.PLANNED)
    rows = records(*({"tick": tick, "flags": int(flag)} for tick, flag in enumerate(flags)))
    assert trace_times.find_missed_cycles(rows).tolist() == [False, True, False, False, True]
    assert trace_times.count_skipped_releases(rows).tolist() == [0, 0, 0, 3, 0]
    assert trace_times.count_misses_and_skips(rows) == (2, 3)
    assert trace_times.select_plans(rows)["tick"].tolist() == [2, 4]


def test_a_distribution_has_the_percentiles_of_its_values() -> None:
    expected = {"min": 0.0, "p50": 500.0, "p99": 990.0, "p99_9": 999.0, "max": 1000.0}
    assert trace_times.compute_distribution(np.arange(1001)) == expected
    assert trace_times.compute_distribution(np.array([])) is None
    thirds = trace_times.compute_distribution(np.array([1 / 3]))
    assert thirds == dict.fromkeys(expected, 0.333333)


def test_a_union_of_occupations_counts_no_time_twice() -> None:
    first = Occupation(np.array([0]), np.array([10]))
    second = Occupation(np.array([5, 30]), np.array([20, 31]))
    whole = np.array([0]), np.array([100])
    assert Occupation.merge([first, second]).compute_overlap(*whole).tolist() == [21]
    assert Occupation.merge([]).compute_overlap(*whole).tolist() == [0]
    # Those that touch or overlap are one.
    union = Occupation(np.array([20, 0, 5, 12]), np.array([22, 5, 9, 10]))
    assert (union.starts.tolist(), union.ends.tolist()) == ([0, 12, 20], [9, 12, 22])


def test_a_task_needs_its_core_from_waking_up_to_closing_the_cycle() -> None:
    occupied = Occupation.from_records(records(cycle(1000, USUAL, 104), cycle(3000, USUAL, 106)))
    # Half of the overhead of 5 ns, before its start and after its end.
    assert (occupied.starts.tolist(), occupied.ends.tolist()) == ([1008, 3008], [1112, 3112])


def test_wake_up_time_is_the_unstamped_time_up_to_the_lateness() -> None:
    rows = records(*(cycle(1000, USUAL, processor) for processor in (90, 100, 104, 130)))
    assert compute_waking_ns(rows).tolist() == [0, 0, 4, 10]
    # Its clock board stamped the release after its start.
    rows["release_ns"] = 1011
    assert compute_waking_ns(rows).tolist() == [0, 0, 0, 0]


def test_the_overhead_is_the_median_of_undisturbed_cycles() -> None:
    processors = (95, 60, 100, 104, 108)
    rows = records(*(cycle(1000, USUAL, processor) for processor in processors))
    assert trace_times.compute_overhead_ns(rows) == 4
    assert trace_times.compute_overhead_ns(rows[:2]) == 0


NOBODY = Occupation.merge([])


def test_time_of_a_higher_task_is_subtracted_from_the_part_it_interrupted() -> None:
    rows = records(cycle(0, (10, 20, 90, 30), 104))
    above = Occupation(np.array([45]), np.array([95]))
    assert trace_times.compute_unit_times(rows, above).tolist() == [list(USUAL)]


def test_a_disturbance_is_subtracted_from_the_part_that_is_longer_than_usual() -> None:
    usual = [cycle(1000 * n, USUAL, 104) for n in range(4)]
    disturbed = cycle(5000, (10, 20, 140, 30), 104)
    # All of its time was its own: the next cycle woke up without any.
    own = cycle(6000, (10, 20, 45, 30), 105)
    times = trace_times.compute_unit_times(records(*usual, disturbed, own), NOBODY)
    assert times[:-1].tolist() == [list(USUAL)] * 5
    assert times[-1].tolist() == [10, 20, 45, 30]
