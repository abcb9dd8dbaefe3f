"""Rules: from the records of a claim's experiments to its verdict."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import ceil, inf

from rack.boards.config import load, rack_timing, wire
from rack.boards.timing.verdicts import EquationVerdict
from rack.tools.lab.reproduction.experiments.figures import (
    FIG2,
    LEAST_X,
    LEVEL,
    MOST_X,
    MS,
    PLANNER,
    FigureRun,
    settings_of,
)
from rack.tools.lab.reproduction.experiments.nasrem import (
    NAME,
    ComparedRun,
    GotoRuns,
    LossesRun,
    NasremRun,
)
from rack.tools.lab.reproduction.experiments.partition import Partition, PartitionFigures
from rack.tools.lab.reproduction.experiments.response import ResponseRun
from rack.tools.lab.reproduction.experiments.sharing import LEVELS, Chains, Waits
from rack.tools.lab.reproduction.experiments.switch import PAPER_US, SwitchRun
from rack.tools.lab.reproduction.experiments.tasks import LATER_MS, NetworkRun, TableRuns, TaskRun
from rack.tools.lab.reproduction.verdict import (
    STRAY,
    Check,
    ClaimVerdict,
    Ruling,
    check_none,
    compare,
    describe_unmet,
    rule_on,
    rule_strays,
)
from rack.tools.timing.charts import figure5

DONE = "task done"
"""The end of a run that has done its task."""
MOSTLY = 0.5
"""Share of late cycles or plans from which on a run fails: a figure fails in all, or in none."""
PAPER_X = [LEAST_X, 1.5, 2.0, 2.5, MOST_X]
"""X of the figures, ms, over the range that the paper permits."""
LEAST_P_MS = 3.0
""""The planner runs at least 3 ms each cycle"."""
EXCHANGE_MS = 40.0
"""Largest difference between two waits for an exchange: a cycle of 20 ms above, two of 10 ms on the
network."""
PAPER_HZ = {"servo": 400.0, "primitive": 50.0}
NOMINAL = 0.01
"""Largest relative difference of a measured rate: skipped cycles lower it."""
FEW = 0.01
"""Share of missed cycles or plans up to which they are stray ones."""
ROUNDING_MS = 1e-6


def check_done(*runs: TaskRun) -> list[Check]:
    """Compare the tasks that were not done with none."""
    return check_none(tasks_not_done=sum(run.ended != DONE for run in runs))


def judge_determinism(runs: Sequence[ComparedRun]) -> ClaimVerdict:
    """Compare digests, and where runs diverge with where they first missed a deadline."""
    digest = runs[0].digest
    lockstep = [run for run in runs if run.mode == "lockstep"]
    real = [run for run in runs if run.mode == "realtime"]
    early = sum(
        run.difference is not None
        and (run.first_miss is None or run.first_miss > run.difference.tick)
        for run in real
    )
    equal = sum(run.first_miss is None and run.digest == digest for run in real)
    return rule_on(
        *check_none(
            lockstep_runs_that_differ=sum(run.digest != digest for run in lockstep),
            realtime_runs_that_differ_before_a_miss=early,
        ),
        ideal=[compare("realtime_runs_equal", equal, ">=", 1)],
    )


def judge_speedup(one: FigureRun, two: FigureRun) -> ClaimVerdict:
    """Compare the plans of the same level on one processor and on two."""
    alone, both = (run.tasks[PLANNER].jobs for run in (one, two))
    needs = [compare("plans_on_one_processor", alone, ">=", 1)]
    return rule_on(compare("plans_on_two_processors", both, ">", alone), needs=needs)


def judge_growth(found: Chains) -> ClaimVerdict:
    """Count missed cycles after boards were added: none has more to do for it."""
    grown = found.grown
    on_time = compare("messages_on_time", grown.took.get(grown.boards, 0), ">=", 1)
    return rule_strays("cycles_missed", grown.missed, grown.due, on_time)


def judge_locks(found: Chains) -> ClaimVerdict:
    """Count missed cycles of boards that lock, read and unlock as the paper's do."""
    return rule_strays("cycles_missed", found.locked.missed, found.locked.due)


def judge_pipeline(found: Chains) -> ClaimVerdict:
    """Compare the cycles that messages took with the number of levels."""
    exact, real = found.lockstep.took, found.realtime.took
    sent, arrived = sum(exact.values()), sum(real.values())
    early = sum(count for took, count in real.items() if took < LEVELS)
    late = arrived - early - real.get(LEVELS, 0)
    off = sent - exact.get(LEVELS, 0)
    # Every level may miss its part.
    share = compare("realtime_messages_late_share", late / max(arrived, 1), "<=", LEVELS * STRAY)
    return rule_on(
        *check_none(lockstep_messages_off=off, realtime_messages_early=early),
        ideal=check_none(realtime_messages_late=late),
        here=[share],
        needs=[compare("messages", min(arrived, sent), ">=", 1)],
    )


def judge_replication() -> ClaimVerdict:
    """Refuse to rule: no experiment replaces a board by a replica."""
    return rule_on(needs=[compare("replicas", 0, ">=", 1)])


def judge_communication(found: NasremRun, partitions: Sequence[PartitionFigures]) -> ClaimVerdict:
    """Compare the processor time of communication with what a second processor takes off one, ms a
    second.
    """
    communication = sum(task.communication_us / task.slice_ms for task in found.executors.values())
    loads = {one.partition: one.loads.values() for one in partitions}
    one, two = (loads[Partition("tight", cores)] for cores in (1, 2))
    saved = 1e3 * (sum(one) - max(two))
    return rule_on(compare("communication_ms_per_s", communication, "<", saved))


def judge_flow(found: NasremRun) -> ClaimVerdict:
    """Compare the commands and statuses of the levels with what the ticks of their writers
    demand.
    """
    ways = [[box for box in found.due if box.endswith(way)] for way in (".command", ".status")]
    boxes = [box for way in ways for box in way]
    # A run may end before the last one is written.
    lacking = sum(max(0, found.due[box] - 1 - found.messages[box]) for box in boxes)
    used = sum(any(found.messages[box] for box in way) for way in ways)
    due = sum(found.due[box] for box in boxes)
    return rule_strays("messages_lacking", lacking, due, compare("ways", used, "=", len(ways)))


def judge_loop(found: NasremRun) -> ClaimVerdict:
    """Compare the cycles that missed their bound with all."""
    tasks = found.executors.values()
    bad = sum(task.missed for task in tasks)
    return rule_strays("cycles_missed", bad, sum(task.cycles for task in tasks))


def judge_losses(*runs: LossesRun) -> ClaimVerdict:
    """Compare when each loss was detected and over with its bounds."""
    faults = [fault for run in runs for fault in run.faults]
    lacking = check_none(
        not_detected_in_bound=sum(not fault.is_within for fault in faults),
        not_recovered_in_bound=sum(not fault.is_recovered for fault in faults),
        tasks_not_done=sum(not run.worked for run in runs),
    )
    struck = sum(fault.struck >= 0 for fault in faults)
    return rule_on(compare("losses", struck, "=", len(faults)), *lacking)


def judge_goto(found: GotoRuns) -> ClaimVerdict:
    """Compare when A was done with the time by which it was promised, s."""
    early, met = found.early, found.met
    begun = early.moved + (early.done_s is not None)
    done_s = inf if met.done_s is None else met.done_s
    promised = compare("done_as_promised_s", done_s, "<=", met.by_s or 0.0)
    return rule_on(*check_none(motions_begun_too_early=begun), promised)


def check_equations(verdicts: Iterable[EquationVerdict]) -> list[Check]:
    """Compare both sides of an equation for every subject, in ms where they are times."""
    checks = []
    for one in verdicts:
        scale = MS if one.unit == "ns" else 1.0
        name = f"{one.subject}: {one.meaning}"
        checks.append(compare(name, one.left * scale, one.sign, one.right * scale))
    return checks


def judge_equation(number: str, found: NasremRun) -> ClaimVerdict:
    """Compare both sides in the worst cycle of every subject; within bounds, in 99 of 100
    cycles.
    """
    verdicts = [one for one in found.verdicts if one.measured.equation == number]
    return rule_on(
        ideal=check_equations(one.measured for one in verdicts),
        here=check_none(failing_in_1_of_100_cycles=sum(not one.mostly for one in verdicts)),
        needs=[compare("subjects", len(verdicts), ">=", 1)],
    )


def judge_sum(found: NasremRun) -> ClaimVerdict:
    """Compare the longest responses with the sum alone, ms; within bounds, with the sum and its
    waits, which a missed cycle may prolong.
    """
    assert found.response is not None, "it is a hierarchy"
    ways = found.response.ways
    checks = [
        compare(f"{name}_ms", way.longest_ms, "<=", found.response.sum_eq_3_3_ms)
        for name, way in ways.items()
        if way.longest_ms is not None
    ]
    unexplained = sum(way.unexplained for way in ways.values())
    return rule_on(
        ideal=checks,
        here=check_none(beyond_grid_without_miss=unexplained),
        needs=[compare("ways", len(checks), "=", 2)],
    )


def judge_background(behind: FigureRun, in_line: FigureRun) -> ClaimVerdict:
    """Count the cycles that are late while a level stores data in the background, and compare with
    storing in the cycle.
    """
    return rule_on(
        compare("blocks_stored", behind.tasks[PLANNER].jobs, ">=", 1),
        compare("stored_in_cycle_late_share", in_line.late(LEVEL), ">=", MOSTLY),
        ideal=check_none(cycles_late=behind.tasks[LEVEL].late),
        here=[compare("cycles_late_share", behind.late(LEVEL), "<=", STRAY)],
    )


def judge_loose(plain: NetworkRun, later: NetworkRun) -> ClaimVerdict:
    """Compare the servo rack's cycles, and when it responds to the machine above, with a network
    and with a slower one.
    """
    later_ms = 0.0
    if plain.response_ms is not None and later.response_ms is not None:
        later_ms = later.response_ms - plain.response_ms
    missed = max(plain.servo_missed, later.servo_missed)
    return rule_on(
        *check_done(plain, later),
        compare("response_off_expected_ms", abs(later_ms - LATER_MS), "<=", EXCHANGE_MS),
        ideal=check_none(servo_missed_share=missed),
        here=[compare("servo_missed_share", missed, "<=", STRAY)],
    )


def judge_waits(found: Waits) -> ClaimVerdict:
    """Compare how late cycles start after polling, and after blocking, us."""
    return rule_on(compare("polling_late_median_us", found.polling_us, "<", found.blocking_us))


def judge_update(found: FigureRun) -> ClaimVerdict:
    """Count the updates of a plan during which the executor began, of all that its release met."""
    return rule_strays("updates_preempted", found.preempted, found.met)


def judge_both(*runs: FigureRun) -> ClaimVerdict:
    """Compare the executors' late cycles with all, in runs in which planners made plans."""
    late = sum(run.tasks[LEVEL].late for run in runs)
    due = sum(run.tasks[LEVEL].jobs for run in runs)
    plans = min(run.tasks[PLANNER].jobs for run in runs)
    return rule_strays("cycles_late", late, due, compare("plans", plans, ">=", 1))


def _compare_late(found: FigureRun, sign: str, name: str = "late_share") -> Check:
    """Compare the larger share of late cycles and of late plans with `MOSTLY`."""
    return compare(name, max(found.late(LEVEL), found.late(PLANNER)), sign, MOSTLY)


def _undisturbed(found: FigureRun) -> list[Check]:
    """Return what a run needs to show the figure: an executor is late in almost all cycles, or in
    none.
    """
    late = found.late(LEVEL)
    return [compare("executor_late_share", late, "<=", STRAY)] if late <= MOSTLY else []


def judge_working(found: FigureRun) -> ClaimVerdict:
    """Rule on a figure of which the paper says that it works."""
    late = check_none(late=sum(count.late for count in found.tasks.values()))
    return rule_on(ideal=late, here=[_compare_late(found, "<=")], needs=_undisturbed(found))


def judge_failing(found: FigureRun, *shorter: FigureRun) -> ClaimVerdict:
    """Rule on a figure of which the paper says that it fails, with the shortest X that the paper
    permits too.
    """
    shortest = [_compare_late(run, ">", "shortest_X_late_share") for run in shorter]
    return rule_on(_compare_late(found, ">"), ideal=shortest, needs=_undisturbed(found))


def check_planning(process_ms: float) -> tuple[Check, Check]:
    """Compare figure 2 with this X, ms, with both sentences on its planner: at least `LEAST_P_MS`
    in each cycle, and a plan in the cycles permitted.
    """
    config = load(FIG2.config, settings_of(FIG2.config, process_ms))
    level = rack_timing(config, wire(config)).level(LEVEL)
    # As the pattern "RXWPU" reads, U too is in every cycle; for a plan to be done, it is once.
    each_ms = (level.residual_ns - level.update_ns) * MS
    work_ns = (level.plan_ns or 0) + level.update_ns
    cycles = ceil(work_ns / level.residual_ns) if level.residual_ns > 0 else inf
    permitted = level.within_cycles or 0
    return (
        compare(f"X={process_ms:g} planner_ms_per_cycle", each_ms, ">=", LEAST_P_MS),
        compare(f"X={process_ms:g} cycles_per_plan", cycles, "<=", permitted),
    )


def judge_sweep(short: FigureRun, long: FigureRun) -> ClaimVerdict:
    """Compare two sentences of the paper with each other, by computation and by two runs."""
    odd = sum(bool(describe_unmet(check_planning(process_ms))) for process_ms in PAPER_X)
    return rule_on(
        compare("contradicting_X", odd, ">=", 1),
        _compare_late(short, "<=", "shortest_X_late_share"),
        _compare_late(long, ">", "longest_X_late_share"),
        holding=Ruling.CONTRADICTS,
    )


def judge_tables(found: TableRuns) -> ClaimVerdict:
    """Compare the state transitions of runs with and without a disturbance."""
    answering = {*found.disturbed.rows} - {*found.undisturbed.rows}
    return rule_on(
        *check_done(found.disturbed, found.undisturbed),
        compare("answering_transitions", len(answering), ">=", 1),
    )


def judge_levels(found: NasremRun) -> ClaimVerdict:
    """Compare the rates of the levels with the paper's, or else with the config's, and the gaps
    between their cycles with two periods: from there on a cycle was left out.
    """
    config = load(NAME)
    rates = check_done(found)
    gaps = []
    for name, task in found.executors.items():
        every = config.every(name)
        own_hz = 1e9 / (every * config.clock_ns)
        rate_hz = own_hz * task.done / -(-found.ticks // every)
        nominal_hz = PAPER_HZ.get(name, own_hz)
        off = abs(rate_hz / nominal_hz - 1.0)
        rates.append(compare(f"{name}_off_{nominal_hz:g}_Hz_share", off, "<=", NOMINAL))
        gaps.append(compare(f"{name}_gap_ms", task.largest_gap_ms, "<", 2.0 * task.slice_ms))
    return rule_on(*rates, ideal=gaps)


def judge_switch(found: SwitchRun) -> ClaimVerdict:
    """Compare this machine's switch with the paper's, and with what the config assumes, us."""
    return rule_on(
        compare("switch_median_us", found.switch_us["p50"], "<=", PAPER_US),
        compare("switch_p99_us", found.switch_us["p99"], "<=", found.assumed_us),
        holding=Ruling.BOUNDED,
    )


def judge_figure_5(found: Sequence[PartitionFigures]) -> ClaimVerdict:
    """Compare what levels miss by partition: do slow levels do with multitasking, and do fast ones
    need more?
    """
    is_slow = {
        one.level: figure5.region_of(one.cycle_s).name == "multitasking"
        for one in figure5.placed(load(NAME))
    }
    tasks = [
        ("slow" if is_slow.get(task.board) else one.partition.coupling, task)
        for one in found
        for task in one.tasks
    ]

    def missed_share(group: str) -> float:
        own = [task for name, task in tasks if name == group]
        bad = sum(task.missed + task.skipped for task in own)
        return bad / max(sum(task.cycles for task in own), 1)

    most = missed_share("loose") + FEW
    plans = min((task.cycles for _, task in tasks if task.role == "planner"), default=0)
    return rule_on(
        compare("slow_levels_missed_share", missed_share("slow"), "<=", FEW),
        ideal=[compare("fast_levels_missed_share", missed_share("tight"), ">", most)],
        needs=[compare("fewest_plans", plans, ">=", 1)],
    )


def judge_systems(names: Iterable[str], *found: TaskRun | TableRuns) -> ClaimVerdict:
    """Compare the responses in whole tasks of these systems with their bounds, ms; a missed cycle
    may prolong them.
    """
    runs = [run.disturbed if isinstance(run, TableRuns) else run for run in found]
    ways = {
        f"{name}_{way}_ms": response
        for name, run in zip(names, runs, strict=True)
        if run.response is not None
        for way, response in run.response.ways.items()
        if response.longest_ms is not None
    }
    return rule_on(
        *check_done(*runs),
        ideal=[
            compare(name, way.longest_ms or 0.0, "<=", way.bound_ms + ROUNDING_MS)
            for name, way in ways.items()
        ],
        here=check_none(late_without_miss=sum(way.unexplained for way in ways.values())),
    )


def judge_layers(names: Iterable[str]) -> ClaimVerdict:
    """Count levels in configs, and the systems in which a level is faster than one below it."""
    configs = {name: load(name) for name in names}
    paths = {name: rack_timing(one, wire(one)).hierarchy for name, one in configs.items()}
    faster = sum(sorted(path.cycles, reverse=True) != [*path.cycles] for path in paths.values())
    levels = (compare(f"{name}_levels", len(path.levels), ">=", 2) for name, path in paths.items())
    return rule_on(*levels, *check_none(systems_with_a_faster_level_above=faster))


def judge_links(
    rates_hz: Mapping[str, int], found: TaskRun, ideal: Sequence[Check] = ()
) -> ClaimVerdict:
    """Compare what passed between the sides of a system with what its rates demand.

    Args:
        rates_hz: Messages a second of each mailbox; 1 for at least one message.
        found: The whole task of the system.
        ideal: What it takes to hold, too; without it, it holds within bounds.
    """
    least = {
        box: (1.0 - STRAY) * rate_hz * found.lasted_s if rate_hz > 1 else 1
        for box, rate_hz in rates_hz.items()
    }
    return rule_on(
        *check_done(found),
        compare("missed_share", found.missed, "<=", STRAY),
        *(
            compare(f"{box}_messages", found.messages.get(box, 0), ">=", count)
            for box, count in least.items()
        ),
        ideal=ideal,
    )


def judge_rccl(rates_hz: Mapping[str, int], found: TaskRun) -> ClaimVerdict:
    """Judge RCCL's links as others; for it to hold, every joint has a processor, too."""
    joints = [task.core for task in wire(load("rccl")).tasks if task.board.startswith("joint")]
    cores = compare("processors_of_joints", len(set(joints)), ">=", len(joints))
    return judge_links(rates_hz, found, [cores])


def judge_predictable(found: ResponseRun) -> ClaimVerdict:
    """Compare responses with the tick predicted, and with equations 3.2 and 3.3; within bounds,
    with the longest that the grid permits instead of the sum of eq. 3.3.
    """
    real = found.realtime
    upper, total = (
        [
            compare(f"{row['level']}_within_{bound}", row["max_from_reading_ms"], "<=", row[bound])
            for row in real.rows()
            if row["commands"]
        ]
        for bound in ("bound_eq_3_2_ms", "sum_eq_3_3_ms")
    )
    return rule_on(
        *check_none(
            lockstep_off_predicted_tick=len(found.lockstep.off),
            lockstep_torque_off_predicted_tick=found.differs != found.predicted,
            realtime_beyond_grid=len(real.beyond),
        ),
        *upper,
        ideal=total,
        needs=[compare("realtime_commands", len(real.measured), ">=", 1)],
    )
