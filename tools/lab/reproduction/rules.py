"""Rules that derive the verdict on a claim from the records of its experiments."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from math import ceil, inf

from rack.boards.config import build_rack_timing, load, resolve_layout
from rack.boards.timing.verdicts import EquationVerdict
from rack.tools.lab.reproduction.experiments.figures import (
    FIG2,
    LEVEL,
    MAX_X_MS,
    MIN_X_MS,
    MS,
    PLANNER,
    FigureRun,
    build_settings,
)
from rack.tools.lab.reproduction.experiments.nasrem import (
    NAME,
    ComparedRun,
    GotoRuns,
    LossesRun,
    NasremRun,
)
from rack.tools.lab.reproduction.experiments.partition import Partition, PartitionFigures
from rack.tools.lab.reproduction.experiments.replication import ReplicationRun
from rack.tools.lab.reproduction.experiments.response import ResponseRun
from rack.tools.lab.reproduction.experiments.sharing import LEVELS, Chains, Waits
from rack.tools.lab.reproduction.experiments.smoothness import (
    RESOLUTION_RAD,
    MotionPoint,
    SmoothnessRun,
)
from rack.tools.lab.reproduction.experiments.speedup import SpeedupRun
from rack.tools.lab.reproduction.experiments.switch import PAPER_US, SwitchRun
from rack.tools.lab.reproduction.experiments.tasks import (
    EXTRA_DELAY_MS,
    NetworkRun,
    TableRuns,
    TaskRun,
)
from rack.tools.lab.reproduction.verdict import (
    MAX_STRAY_SHARE,
    Check,
    ClaimVerdict,
    Ruling,
    check_none,
    compare_value,
    describe_unmet,
    rule_on,
    rule_on_rare_event,
)
from rack.tools.timing.charts import figure5

TASK_DONE = "task done"
"""Reason with which a run ends when its task is done."""
FAILING_SHARE = 0.5
"""Share of late cycles or plans above which a run counts as failing.

A figure fails in all cycles or in none, so the exact value does not matter.
"""
PAPER_X_MS = [MIN_X_MS, 1.5, 2.0, 2.5, MAX_X_MS]
"""Values of X, ms, that cover the range that the paper permits in its figures."""
MIN_PLAN_MS = 3.0
"""Shortest time of the planner per cycle, ms: "The planner runs at least 3 ms each cycle"."""
MAX_EXCHANGE_DIFFERENCE_MS = 40.0
"""Largest difference between two waits for an exchange, ms.

A wait lasts up to one cycle of 20 ms in the machine above, and two of 10 ms on the network.
"""
PAPER_HZ = {"servo": 400.0, "primitive": 50.0}
MAX_RATE_ERROR = 0.01
"""Largest relative error of a measured rate, which skipped cycles lower."""
MAX_FEW_SHARE = 0.01
"""Largest share of missed cycles or plans that counts as stray."""
MAX_OFF_PATH_RAD = 0.01
"""Largest distance of paths that count as the same, rad. A missed cycle shifts a path a little."""


def check_done(*runs: TaskRun) -> list[Check]:
    """Check that all tasks were completed."""
    return check_none(tasks_not_done=sum(run.ended != TASK_DONE for run in runs))


def judge_determinism(runs: Sequence[ComparedRun]) -> ClaimVerdict:
    """Check that lockstep runs are equal and real-time runs diverge only after a missed deadline.

    The claim holds only within bounds if no real-time run without a missed deadline is equal to
    the runs in lockstep.
    """
    digest = runs[0].digest
    lockstep_runs = [run for run in runs if run.mode == "lockstep"]
    realtime_runs = [run for run in runs if run.mode == "realtime"]
    diverged_early = sum(
        run.difference is not None
        and (run.first_miss is None or run.first_miss > run.difference.tick)
        for run in realtime_runs
    )
    equal_count = sum(run.first_miss is None and run.digest == digest for run in realtime_runs)
    return rule_on(
        *check_none(
            lockstep_runs_that_differ=sum(run.digest != digest for run in lockstep_runs),
            realtime_runs_that_differ_before_a_miss=diverged_early,
        ),
        ideal=[compare_value("realtime_runs_equal", equal_count, ">=", 1)],
    )


def judge_speedup(run: SpeedupRun) -> ClaimVerdict:
    """Check that concurrent levels make more plans than a sequential program, on each processor.

    One processor may make fewer, because it also switches between the levels.
    """
    plans = list(run.by_cores.values())
    steps = (
        compare_value(f"plans_per_s_on_{number}_processors", now, ">", before)
        for number, (before, now) in enumerate(pairwise(plans), 2)
    )
    return rule_on(
        *steps,
        compare_value("plans_per_s", max(plans), ">", run.sequential),
        needs=[
            compare_value("sequential_plans_per_s", run.sequential, ">", 0),
            compare_value("processors", len(plans), ">=", 2),
        ],
    )


def judge_growth(small: TaskRun, grown: TableRuns) -> ClaimVerdict:
    """Check that a rack with an additional level runs more closed loops and misses few cycles.

    A level without work commands nothing, so it closes no loop.
    """
    run = grown.disturbed
    return rule_on(
        *check_done(run),
        compare_value("levels", len(run.levels), ">", len(small.levels)),
        ideal=check_none(missed_share=run.missed),
        here=[compare_value("missed_share", run.missed, "<=", MAX_STRAY_SHARE)],
        needs=[compare_value("levels_before", len(small.levels), ">=", 1)],
    )


def judge_flexibility(partitions: Sequence[PartitionFigures]) -> ClaimVerdict:
    """Check that a task is done along the same path in every partition."""
    return rule_on(
        *check_none(tasks_not_done=sum(run.ended != TASK_DONE for run in partitions)),
        compare_value(
            "off_path_rad", max(run.off_path_rad for run in partitions), "<=", MAX_OFF_PATH_RAD
        ),
        needs=[
            compare_value("partitions", len({run.partition for run in partitions}), ">=", 2),
            compare_value("moved_rad", min(run.moved_rad for run in partitions), ">", 1.0),
        ],
    )


def judge_locks(chains: Chains) -> ClaimVerdict:
    """Check that boards that lock, read and unlock, as the paper's do, miss no cycles."""
    return rule_on_rare_event("cycles_missed", chains.locked.missed, chains.locked.due)


def judge_pipeline(chains: Chains) -> ClaimVerdict:
    """Check that every message passes the chain in exactly as many cycles as there are levels."""
    lockstep_counts, realtime_counts = chains.lockstep.took, chains.realtime.took
    sent, arrived = sum(lockstep_counts.values()), sum(realtime_counts.values())
    early = sum(count for took, count in realtime_counts.items() if took < LEVELS)
    late = arrived - early - realtime_counts.get(LEVELS, 0)
    lockstep_off = sent - lockstep_counts.get(LEVELS, 0)
    # Each level may miss a small share of its cycles.
    share = compare_value(
        "realtime_messages_late_share", late / max(arrived, 1), "<=", LEVELS * MAX_STRAY_SHARE
    )
    return rule_on(
        *check_none(lockstep_messages_off=lockstep_off, realtime_messages_early=early),
        ideal=check_none(realtime_messages_late=late),
        here=[share],
        needs=[compare_value("messages", min(arrived, sent), ">=", 1)],
    )


def judge_replication(run: ReplicationRun) -> ClaimVerdict:
    """Check that with a standby the loss of a moving arm's servo level changes no message."""
    lost = run.replicated
    return rule_on(
        compare_value("hand_overs", lost.hand_overs, "=", 1),
        *check_none(
            ticks_without_torque=lost.ticks_without_torque,
            brakings=lost.brakings,
            messages_missing=lost.messages_missing,
            digests_that_differ=lost.digest != run.undisturbed.digest,
        ),
        needs=[compare_value("ticks_without_torque_alone", run.alone.ticks_without_torque, ">", 0)],
    )


def judge_communication(run: NasremRun, partitions: Sequence[PartitionFigures]) -> ClaimVerdict:
    """Check that communication takes less processor time than a second processor saves.

    Both are in ms per second.
    """
    communication = sum(task.communication_us / task.slice_ms for task in run.executors.values())
    loads = {each.partition: each.loads.values() for each in partitions}
    one_core, two_cores = (loads[Partition("tight", cores)] for cores in (1, 2))
    saved_ms = 1e3 * (sum(one_core) - max(two_cores))
    return rule_on(compare_value("communication_ms_per_s", communication, "<", saved_ms))


def judge_flow(run: NasremRun) -> ClaimVerdict:
    """Check that the writers of commands and statuses sent a message in every cycle."""
    ways = [[box for box in run.due if box.endswith(way)] for way in (".command", ".status")]
    boxes = [box for way in ways for box in way]
    # A run may end before the last message is written.
    missing = sum(max(0, run.due[box] - 1 - run.messages[box]) for box in boxes)
    used_ways = sum(any(run.messages[box] for box in way) for way in ways)
    due = sum(run.due[box] for box in boxes)
    return rule_on_rare_event(
        "messages_lacking", missing, due, compare_value("ways", used_ways, "=", len(ways))
    )


def judge_loop(run: NasremRun) -> ClaimVerdict:
    """Check that no cycle was missed."""
    tasks = run.executors.values()
    bad = sum(task.missed for task in tasks)
    return rule_on_rare_event("cycles_missed", bad, sum(task.cycles for task in tasks))


def judge_losses(*runs: LossesRun) -> ClaimVerdict:
    """Check that every loss is detected and recovered within its bounds.

    All tasks must be completed despite the losses.
    """
    faults = [fault for run in runs for fault in run.faults]
    failures = check_none(
        not_detected_in_bound=sum(not fault.is_within for fault in faults),
        not_recovered_in_bound=sum(not fault.is_recovered for fault in faults),
        tasks_not_done=sum(not run.worked for run in runs),
    )
    struck_count = sum(fault.struck >= 0 for fault in faults)
    return rule_on(compare_value("losses", struck_count, "=", len(faults)), *failures)


def judge_goto(runs: GotoRuns) -> ClaimVerdict:
    """Check that A is reached by its deadline, and that the arm does not move if it cannot be."""
    early, met = runs.early, runs.met
    begun = early.moved + (early.done_s is not None)
    done_s = inf if met.done_s is None else met.done_s
    promised = compare_value("done_as_promised_s", done_s, "<=", met.by_s or 0.0)
    return rule_on(*check_none(motions_begun_too_early=begun), promised)


def check_equations(verdicts: Iterable[EquationVerdict]) -> list[Check]:
    """Convert each verdict to a comparison of both sides of its equation, with times in ms."""
    checks = []
    for verdict in verdicts:
        scale = MS if verdict.unit == "ns" else 1.0
        name = f"{verdict.subject}: {verdict.meaning}"
        checks.append(
            compare_value(name, verdict.left * scale, verdict.sign, verdict.right * scale)
        )
    return checks


def judge_equation(number: str, run: NasremRun) -> ClaimVerdict:
    """Check that an equation holds in the worst cycle of every subject.

    The claim holds within bounds if the equation holds in 99 of 100 cycles.
    """
    verdicts = [each for each in run.verdicts if each.measured.equation == number]
    return rule_on(
        ideal=check_equations(each.measured for each in verdicts),
        here=check_none(failing_in_1_of_100_cycles=sum(not each.mostly for each in verdicts)),
        needs=[compare_value("subjects", len(verdicts), ">=", 1)],
    )


def judge_sum(run: NasremRun) -> ClaimVerdict:
    """Check that the longest response in each direction is at most the sum of equation 3.3.

    If it is longer, the claim still holds within bounds, provided that a missed cycle delayed every
    response that exceeds the longest one possible on the grid.
    """
    assert run.response is not None, "it is a hierarchy"
    ways = run.response.ways
    checks = [
        compare_value(f"{name}_ms", way.longest_ms, "<=", run.response.sum_eq_3_3_ms)
        for name, way in ways.items()
        if way.longest_ms is not None
    ]
    unexplained = sum(way.unexplained for way in ways.values())
    return rule_on(
        ideal=checks,
        here=check_none(beyond_grid_without_miss=unexplained),
        needs=[compare_value("ways", len(checks), "=", 2)],
    )


def judge_smoothness(run: SmoothnessRun) -> ClaimVerdict:
    """Check that motion becomes rougher with the deviation and with the length of the cycle.

    From point to point of each sweep, tracking error, jerk and number of brakings must not fall,
    except for the resolution of the encoders, and error and jerk must rise over the sweep. An
    overrun within the residual must change nothing. The brakes must engage at the largest jitter.
    """
    still = run.undisturbed
    within = [point for point in run.overrun if point.value < 1.0]
    beyond = [point for point in run.overrun if point.value >= 1.0]
    changed = sum(replace(point, value=still.value) != still for point in within)
    sweeps = {"jitter": run.jitter, "overrun": beyond, "rate": run.rate}
    return rule_on(
        *check_none(overruns_within_residual_that_change=changed),
        *(check for name, points in sweeps.items() for check in _check_growth(name, still, points)),
        compare_value("brakings_at_largest_jitter", run.jitter[-1].brakings, ">=", 1),
        needs=[
            compare_value("moved_rad", still.moved_rad, ">", 1.0),
            compare_value("brakings_undisturbed", still.brakings, "=", 0),
            compare_value("overruns_within_residual", len(within), ">=", 1),
            compare_value("fewest_points", min(map(len, sweeps.values())), ">=", 2),
        ],
    )


def _check_growth(name: str, still: MotionPoint, points: Sequence[MotionPoint]) -> Iterator[Check]:
    """Yield the checks that the motion is rougher at each point of a sweep than before."""
    steps = list(pairwise((still, *points)))
    least_mrad = 1e3 * RESOLUTION_RAD
    falls = {
        "error": sum(now.error_mrad < before.error_mrad - least_mrad for before, now in steps),
        "jerk": sum(now.jerk_rad_s3 < before.jerk_rad_s3 for before, now in steps),
        "brakings": sum(now.brakings < before.brakings for before, now in steps),
    }
    yield from check_none(**{f"{name}_falls_of_{what}": count for what, count in falls.items()})
    last = points[-1]
    grown_mrad = still.error_mrad + least_mrad
    yield compare_value(f"{name}_error_mrad", last.error_mrad, ">", grown_mrad)
    yield compare_value(f"{name}_jerk_rad_s3", last.jerk_rad_s3, ">", still.jerk_rad_s3)


def judge_background(background: FigureRun, in_cycle: FigureRun) -> ClaimVerdict:
    """Check that a level is late if it stores data in its cycle, but not if its planner does so."""
    return rule_on(
        compare_value("blocks_stored", background.tasks[PLANNER].jobs, ">=", 1),
        compare_value(
            "stored_in_cycle_late_share", in_cycle.compute_late_share(LEVEL), ">=", FAILING_SHARE
        ),
        ideal=check_none(cycles_late=background.tasks[LEVEL].late),
        here=[
            compare_value(
                "cycles_late_share", background.compute_late_share(LEVEL), "<=", MAX_STRAY_SHARE
            )
        ],
    )


def judge_loose_coupling(normal: NetworkRun, slower: NetworkRun) -> ClaimVerdict:
    """Check that a slower network delays the response by about `EXTRA_DELAY_MS`.

    The servo rack must not miss any cycle.
    """
    later_ms = 0.0
    if normal.response_ms is not None and slower.response_ms is not None:
        later_ms = slower.response_ms - normal.response_ms
    missed = max(normal.servo_missed, slower.servo_missed)
    return rule_on(
        *check_done(normal, slower),
        compare_value(
            "response_off_expected_ms",
            abs(later_ms - EXTRA_DELAY_MS),
            "<=",
            MAX_EXCHANGE_DIFFERENCE_MS,
        ),
        ideal=check_none(servo_missed_share=missed),
        here=[compare_value("servo_missed_share", missed, "<=", MAX_STRAY_SHARE)],
    )


def judge_waits(waits: Waits) -> ClaimVerdict:
    """Check that the median lateness, in us, is smaller with polling than with blocking."""
    return rule_on(
        compare_value("polling_late_median_us", waits.polling_us, "<", waits.blocking_us)
    )


def judge_update(run: FigureRun) -> ClaimVerdict:
    """Check that no plan update is preempted, even if the executor is released during it."""
    return rule_on_rare_event("updates_preempted", run.preempted, run.met)


def judge_concurrency(*runs: FigureRun) -> ClaimVerdict:
    """Check that executors are never late in runs in which planners make plans."""
    late = sum(run.tasks[LEVEL].late for run in runs)
    due = sum(run.tasks[LEVEL].jobs for run in runs)
    plans = min(run.tasks[PLANNER].jobs for run in runs)
    return rule_on_rare_event("cycles_late", late, due, compare_value("plans", plans, ">=", 1))


def _compare_largest_late_share(run: FigureRun, sign: str, name: str = "late_share") -> Check:
    """Compare the larger of the shares of late cycles and late plans with `FAILING_SHARE`."""
    return compare_value(
        name,
        max(run.compute_late_share(LEVEL), run.compute_late_share(PLANNER)),
        sign,
        FAILING_SHARE,
    )


def _check_undisturbed(run: FigureRun) -> list[Check]:
    """Return the check that other programs did not disturb a run of a figure.

    Without a disturbance, an executor is late in almost all cycles or in almost none. The list is
    empty if it is late in most cycles.
    """
    late_share = run.compute_late_share(LEVEL)
    return (
        [compare_value("executor_late_share", late_share, "<=", MAX_STRAY_SHARE)]
        if late_share <= FAILING_SHARE
        else []
    )


def judge_working(run: FigureRun) -> ClaimVerdict:
    """Check that no job is late in a figure that, according to the paper, works."""
    late = check_none(late=sum(count.late for count in run.tasks.values()))
    return rule_on(
        ideal=late, here=[_compare_largest_late_share(run, "<=")], needs=_check_undisturbed(run)
    )


def judge_failing(paper_run: FigureRun, *shorter: FigureRun) -> ClaimVerdict:
    """Check that many jobs are late in a figure that, according to the paper, fails.

    Args:
        paper_run: Run of the figure.
        shorter: Runs with the shortest X that the paper permits. They should fail as well.
    """
    shortest = [_compare_largest_late_share(run, ">", "shortest_X_late_share") for run in shorter]
    return rule_on(
        _compare_largest_late_share(paper_run, ">"),
        ideal=shortest,
        needs=_check_undisturbed(paper_run),
    )


def check_planning(process_ms: float) -> tuple[Check, Check]:
    """Check two sentences of the paper about figure 2's planner for one value of X.

    They say that the planner runs for at least `MIN_PLAN_MS` in each cycle, and that it finishes a
    plan within the permitted number of cycles.

    Args:
        process_ms: X, the processor time of the executor in a cycle, ms.
    """
    config = load(FIG2.config, build_settings(FIG2.config, process_ms))
    level = build_rack_timing(config, resolve_layout(config)).levels[LEVEL]
    # In the pattern "RXWPU" each cycle contains U, but a whole plan needs U only once.
    each_ms = (level.residual_ns - level.update_ns) * MS
    work_ns = (level.plan_ns or 0) + level.update_ns
    cycles = ceil(work_ns / level.residual_ns) if level.residual_ns > 0 else inf
    permitted = level.within_cycles or 0
    return (
        compare_value(f"X={process_ms:g} planner_ms_per_cycle", each_ms, ">=", MIN_PLAN_MS),
        compare_value(f"X={process_ms:g} cycles_per_plan", cycles, "<=", permitted),
    )


def judge_sweep(short: FigureRun, long: FigureRun) -> ClaimVerdict:
    """Check, by computation and in runs, that the paper's two sentences contradict each other.

    These are the sentences that `check_planning` evaluates.
    """
    count = sum(bool(describe_unmet(check_planning(process_ms))) for process_ms in PAPER_X_MS)
    return rule_on(
        compare_value("contradicting_X", count, ">=", 1),
        _compare_largest_late_share(short, "<=", "shortest_X_late_share"),
        _compare_largest_late_share(long, ">", "longest_X_late_share"),
        holding=Ruling.CONTRADICTS,
    )


def judge_tables(runs: TableRuns) -> ClaimVerdict:
    """Check that a disturbance causes state transitions that do not occur without it."""
    answering_rows = {*runs.disturbed.rows} - {*runs.undisturbed.rows}
    return rule_on(
        *check_done(runs.disturbed, runs.undisturbed),
        compare_value("answering_transitions", len(answering_rows), ">=", 1),
    )


def judge_levels(run: NasremRun) -> ClaimVerdict:
    """Check that every level runs at its nominal rate and leaves out no cycle.

    The nominal rate is given by the paper or, if the paper gives none, by the config. A gap of two
    periods or more between cycles means that a cycle was left out.
    """
    config = load(NAME)
    rates = check_done(run)
    gaps = []
    for name, task in run.executors.items():
        every = config.find_period(name)
        config_hz = 1e9 / (every * config.clock_ns)
        rate_hz = config_hz * task.done / -(-run.ticks // every)
        nominal_hz = PAPER_HZ.get(name, config_hz)
        rate_error = abs(rate_hz / nominal_hz - 1.0)
        rates.append(
            compare_value(f"{name}_off_{nominal_hz:g}_Hz_share", rate_error, "<=", MAX_RATE_ERROR)
        )
        gaps.append(compare_value(f"{name}_gap_ms", task.largest_gap_ms, "<", 2.0 * task.slice_ms))
    return rule_on(*rates, ideal=gaps)


def judge_switch(run: SwitchRun) -> ClaimVerdict:
    """Check that the median switch time is at most the paper's and the p99 at most the config's."""
    return rule_on(
        compare_value("switch_median_us", run.switch_us["p50"], "<=", PAPER_US),
        compare_value("switch_p99_us", run.switch_us["p99"], "<=", run.assumed_us),
        holding=Ruling.BOUNDED,
    )


def judge_figure_5(partitions: Sequence[PartitionFigures]) -> ClaimVerdict:
    """Check that slow levels miss few cycles, and that tight coupling makes fast levels miss more.

    According to the figure, multitasking is enough for slow levels, but fast levels need separate
    processors.
    """
    is_slow = {
        one.level: figure5.find_region(one.cycle_s).name == "multitasking"
        for one in figure5.place_levels(load(NAME))
    }
    tasks = [
        ("slow" if is_slow.get(task.board) else one.partition.coupling, task)
        for one in partitions
        for task in one.tasks
    ]

    def missed_share(group: str) -> float:
        """Return the fraction of a group's cycles that were missed or skipped."""
        group_tasks = [task for name, task in tasks if name == group]
        bad = sum(task.missed + task.skipped for task in group_tasks)
        return bad / max(sum(task.cycles for task in group_tasks), 1)

    max_missed = missed_share("loose") + MAX_FEW_SHARE
    plans = min((task.cycles for _, task in tasks if task.role == "planner"), default=0)
    return rule_on(
        compare_value("slow_levels_missed_share", missed_share("slow"), "<=", MAX_FEW_SHARE),
        ideal=[compare_value("fast_levels_missed_share", missed_share("tight"), ">", max_missed)],
        needs=[compare_value("fewest_plans", plans, ">=", 1)],
    )


def judge_predictable(run: ResponseRun) -> ClaimVerdict:
    """Check that responses occur at the predicted ticks and within the bounds of eqs 3.2 and 3.3.

    If only the sum of equation 3.3 is exceeded, the claim holds within bounds.
    """
    realtime = run.realtime
    upper_checks, sum_checks = (
        [
            compare_value(
                f"{row['level']}_within_{bound}", row["max_from_reading_ms"], "<=", row[bound]
            )
            for row in realtime.build_rows()
            if row["commands"]
        ]
        for bound in ("bound_eq_3_2_ms", "sum_eq_3_3_ms")
    )
    return rule_on(
        *check_none(
            lockstep_off_predicted_tick=len(run.lockstep.mispredicted_commands),
            realtime_beyond_grid=len(realtime.commands_beyond_bound),
        ),
        *upper_checks,
        ideal=sum_checks,
        needs=[compare_value("realtime_commands", len(realtime.measured_commands), ">=", 1)],
    )
