"""Rules and the table of claims.

The table has every section, equation and figure of the paper. Every rule gives each of its rulings
for invented records.
"""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import pytest

from rack.boards.timing.verdicts import EquationVerdict
from rack.tools.console.answer import Failure
from rack.tools.lab.reproduction.experiments.experiment import StoredResult
from rack.tools.lab.reproduction.experiments.figures import LEVEL, PLANNER, FigureRun
from rack.tools.lab.reproduction.experiments.nasrem import (
    ComparedRun,
    GotoRun,
    GotoRuns,
    MeasuredVerdict,
    NasremRun,
)
from rack.tools.lab.reproduction.experiments.partition import (
    Partition,
    PartitionFigures,
    TaskFigures,
)
from rack.tools.lab.reproduction.experiments.replication import LossRun, ReplicationRun
from rack.tools.lab.reproduction.experiments.sharing import ChainRun, Chains
from rack.tools.lab.reproduction.experiments.smoothness import MotionPoint, SmoothnessRun
from rack.tools.lab.reproduction.experiments.speedup import SpeedupRun
from rack.tools.lab.reproduction.experiments.switch import SwitchRun
from rack.tools.lab.reproduction.experiments.tasks import (
    TASKS,
    NetworkRun,
    SystemResponse,
    TableRun,
    TableRuns,
    TaskRun,
    WayResponse,
    parse_response,
)
from rack.tools.lab.reproduction.reproduction import SECTIONS, list_experiments, select_sections
from rack.tools.lab.reproduction.rules import TASK_DONE
from rack.tools.lab.reproduction.verdict import ClaimVerdict, Ruling, describe_unmet
from rack.tools.recording.divergence import DivergentMessage
from rack.tools.timing.charts.panel import JobCount

CLAIMS = {claim.name: claim for section in SECTIONS for claim in section.claims}
NUMBERS = ["abstract", "1", "2", "3", "3.1", "3.2", "3.3", "3.4", "4", "4.1", "5"]
EQUATIONS = [f"equation-3.{number}" for number in range(1, 11)]
HOLDS, BOUNDED, FAILS = Ruling.HOLDS, Ruling.BOUNDED, Ruling.FAILS
WAY = WayResponse(3.0, 5.0, 0)
RESPONSE = SystemResponse(4.0, {"command": WAY, "status": WAY})
RUN = NasremRun(TASK_DONE, 2.0, 0.0, {}, RESPONSE, 800, (), {}, {})


def test_every_section_equation_and_figure_of_the_paper_is_on_the_page_in_its_order() -> None:
    assert [section.section for section in SECTIONS] == NUMBERS
    assert sum(len(section.claims) for section in SECTIONS) == len(CLAIMS)
    assert [name for name in CLAIMS if name.startswith("equation-")] == EQUATIONS
    assert {f"figure-{n}" for n in range(1, 6)} <= CLAIMS.keys()
    found = list_experiments(SECTIONS)
    assert len({one.name for one in found}) == len(found)
    assert sum(one.seconds for one in found) < 15 * 60
    with pytest.raises(Failure, match=r"--only 6: no such section; sections: abstract, 1, 2"):
        select_sections(["6"])


@pytest.mark.parametrize("name", EQUATIONS)
def test_each_equation_holds_in_nasrem_and_fails_in_its_counterexample(name: str) -> None:
    nasrem, failing = CLAIMS[name].predict()
    assert nasrem.checks
    assert describe_unmet(nasrem.checks) == ""
    if name == "equation-3.7":
        assert "60 Hz does not divide the 400 Hz clock" in failing.text
    else:
        assert describe_unmet(failing.checks)


def rule_on(name: str, *found: Any) -> ClaimVerdict:
    """Return the verdict on a claim by results that have passed through their file format."""
    claim = CLAIMS[name]
    pairs = list(zip(claim.experiments, found, strict=True))
    return claim.judge(
        *(one.parse_record(json.loads(json.dumps(one.to_document(run)))) for one, run in pairs)
    )


def compared(mode: str, digest: str, miss: int | None = None, differs: int | None = None) -> Any:
    """Return a run with a digest."""
    difference = None if differs is None else DivergentMessage("servo.status", 1, differs, differs)
    return ComparedRun(mode, digest, miss, difference)


def determined(*runs: ComparedRun, second: str = "a") -> tuple[ComparedRun, ...]:
    """Return runs in real time after two in lockstep."""
    differs = None if second == "a" else 1
    return compared("lockstep", "a"), compared("lockstep", second, differs=differs), *runs


EQUAL = compared("realtime", "a")
EMPTY = ChainRun(9, 0, {})


def chains(lockstep: dict[int, int], realtime: dict[int, int]) -> Chains:
    """Return chains with the numbers of cycles that messages took."""
    return Chains(replace(EMPTY, took=lockstep), replace(EMPTY, took=realtime), EMPTY)


def goto(refused: bool, done_s: float) -> GotoRuns:
    """Return runs with a time that is too early, and by 10 s."""
    early = GotoRun(4.0, None if refused else 5.0, None, not refused)
    return GotoRuns(early, GotoRun(10.0, done_s, None, True))


def tables(*rows: str, ended: str = TASK_DONE) -> TableRuns:
    """Return runs in which only the row "pick" fires without a disturbance."""
    calm = TableRun(TASK_DONE, 9.0, 0.0, {}, None, ("pick",))
    return TableRuns(replace(calm, ended=ended, rows=rows), calm)


def background(late: int, blocks: int, in_line: int) -> tuple[FigureRun, FigureRun]:
    """Return runs of 100 cycles in which blocks are stored in the background and in the cycle."""
    behind, line = (
        FigureRun({LEVEL: JobCount(100, bad), PLANNER: JobCount(blocks, 0)}, 0, 0)
        for bad in (late, in_line)
    )
    return behind, line


def networks(
    missed: float, response_ms: float | None, ended: str = TASK_DONE
) -> tuple[NetworkRun, NetworkRun]:
    """Return a run of two racks, and one with a network slower by 100 ms."""
    plain = NetworkRun(TASK_DONE, 8.0, 0.0, {}, None, 0.0, 50.0)
    return plain, replace(plain, ended=ended, servo_missed=missed, response_ms=response_ms)


def switch(assumed_us: float) -> SwitchRun:
    """Return a context switch of 5 us."""
    times = {"min": 4.0, "p50": 5.0, "p99": 9.0, "p99_9": 9.0, "max": 12.0}
    return SwitchRun(times, assumed_us)


def partitions(slow: int, fast: int, plans: int) -> tuple[PartitionFigures, ...]:
    """Return what levels miss of 100 cycles: a slow one, and a fast one on one processor."""

    def figures(partition: Partition, missed: dict[str, int]) -> PartitionFigures:
        executors = [TaskFigures(level, "executor", 100, bad, 0) for level, bad in missed.items()]
        planners = [TaskFigures(level, "planner", plans, 0, 0) for level in missed]
        return PartitionFigures(partition, (*executors, *planners), {0: 0.5}, TASK_DONE, 2.0, 0.0)

    tight = figures(Partition("tight", 1), {"task": slow, "servo": fast})
    loose = figures(Partition("loose", 2), {"task": slow, "servo": 0})
    return tight, loose


def whole_partitions(**changes: Any) -> tuple[PartitionFigures, ...]:
    """Return the same task in two partitions, of which the second has these changes."""
    first, second = partitions(0, 0, 1)
    return first, replace(second, **changes)


def grown(levels: int, missed: float = 0.0, ended: str = TASK_DONE) -> tuple[TaskRun, TableRuns]:
    """Return a run with three levels, and one with an additional board."""
    small = TaskRun("time over", 3.0, 0.0, {}, None, levels=(9, 99, 99))
    runs = tables("pick", ended=ended)
    run = replace(runs.disturbed, missed=missed, levels=(9,) * levels)
    return small, replace(runs, disturbed=run)


def layers(*cycles: int) -> list[Any]:
    """Return the whole tasks of all systems, one with other cycles of its levels."""
    nasrem, table, network, first, *others = whole_tasks(5.0, 0)
    levels = (9, 99)
    table = replace(table, disturbed=replace(table.disturbed, levels=levels))
    rest = [replace(run, levels=levels) for run in (nasrem, network, *others)]
    return [rest[0], table, rest[1], replace(first, levels=cycles), *rest[2:]]


def equation(name: str, holds: bool, mostly: bool) -> NasremRun:
    """Return a run with an equation measured for one level."""
    left = 1e6 if holds else 3e6
    measured = EquationVerdict(name.removeprefix("equation-"), "servo", left, "<=", 2.5e6, "")
    return replace(RUN, verdicts=(MeasuredVerdict(measured, mostly),))


def response(delay: str) -> NasremRun:
    """Return a run in which commands took 6 ms instead of the 4 ms of equation 3.3, one of them
    beyond the grid, delayed by this."""
    way = {
        "measured_ms": {"max": 6.0},
        "bound_ms": 5.0,
        "beyond": [{"delayed_by": [delay], "network": []}],
    }
    found = {"command": way, "status": {"measured_ms": None, "bound_ms": 5.0, "beyond": []}}
    late = parse_response({**found, "sum_eq_3_3_ms": 4.0, "crosses_racks": False})
    assert late is not None
    return replace(RUN, response=replace(late, ways={**late.ways, "status": WAY}))


def whole_tasks(longest_ms: float, unexplained: int, ended: str = TASK_DONE) -> list[Any]:
    """Return the whole tasks of all systems, one of which responded within 5 ms at most, or
    not."""
    way = WayResponse(longest_ms, 5.0, unexplained)
    answer = SystemResponse(4.0, {"command": way, "status": WAY})
    run = TaskRun(ended, 8.0, 0.0, {}, answer)
    network = NetworkRun(TASK_DONE, 8.0, 0.0, {}, None, 0.0, 50.0)
    runs = [network, run, *[replace(run, response=None, ended=TASK_DONE)] * (len(TASKS) - 2)]
    return [RUN, tables("pick"), *runs]


def moved(value: float, error_mrad: float, jerk: float, brakings: int) -> MotionPoint:
    """Return the motion at a point of a sweep."""
    return MotionPoint(value, 0.1 * value, error_mrad, jerk, brakings, 5.0)


STILL = moved(0.0, 0.3, 60.0, 0)
REPLACED = LossRun("7b", 0, 0, 0, 1)
REPLICATED = ReplicationRun(
    undisturbed=replace(REPLACED, hand_overs=0),
    alone=LossRun("c7", 200, 1, 200, 0),
    replicated=REPLACED,
)
SMOOTH = SmoothnessRun(
    STILL,
    jitter=(moved(0.05, 0.4, 66.0, 0), moved(0.4, 0.7, 360.0, 5)),
    overrun=(replace(STILL, value=0.95), moved(2.0, 0.3, 80.0, 0), moved(4.0, 3.2, 340.0, 0)),
    rate=(moved(100.0, 0.28, 75.0, 0), moved(50.0, 12.0, 15000.0, 1)),
)
RULINGS = [
    ("smooth-motion", [SMOOTH], HOLDS),
    ("smooth-motion", [replace(SMOOTH, jitter=SMOOTH.jitter[::-1])], FAILS),
    ("smooth-motion", [replace(SMOOTH, jitter=(STILL, STILL))], FAILS),
    ("smooth-motion", [replace(SMOOTH, rate=(STILL, STILL))], FAILS),
    (
        "smooth-motion",
        [replace(SMOOTH, overrun=(moved(0.95, 0.31, 60.0, 0), *SMOOTH.overrun[1:]))],
        FAILS,
    ),
    ("smooth-motion", [replace(SMOOTH, jitter=(moved(0.05, 0.4, 66.0, 0),) * 2)], FAILS),
    ("smooth-motion", [replace(SMOOTH, overrun=SMOOTH.overrun[1:])], Ruling.UNTESTABLE),
    ("smooth-motion", [replace(SMOOTH, undisturbed=moved(0, 0.3, 60.0, 1))], Ruling.UNTESTABLE),
    ("determinism", [determined(EQUAL)], HOLDS),
    ("determinism", [determined(compared("realtime", "b", 4, 5), EQUAL)], HOLDS),
    ("determinism", [determined(compared("realtime", "b", 4, 5))], BOUNDED),
    ("determinism", [determined(compared("realtime", "b", 6, 5))], FAILS),
    ("determinism", [determined(compared("realtime", "b", None, 5))], FAILS),
    ("determinism", [determined(EQUAL, second="b")], FAILS),
    ("pipeline", [chains({5: 9}, {5: 9})], HOLDS),
    ("pipeline", [chains({5: 9}, {5: 98, 6: 2})], BOUNDED),
    ("pipeline", [chains({5: 9}, {5: 8, 6: 1})], FAILS),
    ("pipeline", [chains({5: 8, 6: 1}, {5: 9})], FAILS),
    ("pipeline", [chains({5: 9}, {4: 1, 5: 8})], FAILS),
    ("pipeline", [chains({5: 9}, {})], Ruling.UNTESTABLE),
    ("soft-and-real-time", [goto(True, 9.9)], HOLDS),
    ("soft-and-real-time", [goto(True, 10.2)], FAILS),
    ("soft-and-real-time", [goto(False, 9.9)], FAILS),
    ("state-tables", [tables("pick", "aim again")], HOLDS),
    ("state-tables", [tables("pick")], FAILS),
    ("state-tables", [tables("pick", "aim again", ended="time over")], FAILS),
    ("systems", whole_tasks(5.0, 0), HOLDS),
    ("systems", whole_tasks(6.0, 0), BOUNDED),
    ("systems", whole_tasks(6.0, 1), FAILS),
    ("systems", whole_tasks(5.0, 0, "time over"), FAILS),
    ("speedup", [SpeedupRun(260.0, {1: 190.0, 2: 410.0})], HOLDS),
    ("speedup", [SpeedupRun(260.0, {1: 190.0, 2: 180.0})], FAILS),
    ("speedup", [SpeedupRun(430.0, {1: 190.0, 2: 410.0})], FAILS),
    ("speedup", [SpeedupRun(260.0, {1: 190.0})], Ruling.UNTESTABLE),
    ("growth", grown(5), HOLDS),
    ("growth", grown(5, missed=0.01), BOUNDED),
    ("growth", grown(5, missed=0.03), FAILS),
    ("growth", grown(3), FAILS),
    ("growth", grown(5, ended="time over"), FAILS),
    ("flexibility", [whole_partitions()], HOLDS),
    ("flexibility", [whole_partitions(off_path_rad=0.1)], FAILS),
    ("flexibility", [whole_partitions(ended="time over")], FAILS),
    ("flexibility", [whole_partitions(moved_rad=0.0)], Ruling.UNTESTABLE),
    ("two-levels", layers(9, 99), HOLDS),
    ("two-levels", layers(9, 9), HOLDS),
    ("two-levels", layers(99, 9), FAILS),
    ("two-levels", layers(), FAILS),
    ("background", background(0, 9, 99), HOLDS),
    ("background", background(2, 9, 99), BOUNDED),
    ("background", background(3, 9, 99), FAILS),
    ("background", background(0, 0, 99), FAILS),
    ("background", background(0, 9, 9), FAILS),
    ("loosely-coupled", networks(0.0, 150.0), HOLDS),
    ("loosely-coupled", networks(0.01, 150.0), BOUNDED),
    ("loosely-coupled", networks(0.03, 150.0), FAILS),
    ("loosely-coupled", networks(0.0, 60.0), FAILS),
    ("loosely-coupled", networks(0.0, 250.0), FAILS),
    ("loosely-coupled", networks(0.0, None), FAILS),
    ("loosely-coupled", networks(0.0, 150.0, "time over"), FAILS),
    ("context-switch", [switch(50.0)], BOUNDED),
    ("context-switch", [switch(8.0)], FAILS),
    ("figure-5", [partitions(0, 0, 1)], BOUNDED),
    ("figure-5", [partitions(0, 50, 1)], HOLDS),
    ("figure-5", [partitions(50, 50, 1)], FAILS),
    ("figure-5", [partitions(0, 50, 0)], Ruling.UNTESTABLE),
    ("equation-3.1", [equation("3.1", True, True)], HOLDS),
    ("equation-3.1", [equation("3.1", False, True)], BOUNDED),
    *(
        (name, [equation(name, False, False)], FAILS)
        for name in EQUATIONS
        if name != "equation-3.3"
    ),
    ("equation-3.1", [RUN], Ruling.UNTESTABLE),
    ("equation-3.3", [RUN], HOLDS),
    ("equation-3.3", [response("task missed 1 cycle")], BOUNDED),
    ("equation-3.3", [response("task: waited")], FAILS),
    ("replication", [REPLICATED], HOLDS),
    *(
        ("replication", [replace(REPLICATED, replicated=replace(REPLACED, **change))], FAILS)
        for change in (
            {"hand_overs": 0},
            {"ticks_without_torque": 1},
            {"brakings": 1},
            {"messages_missing": 1},
            {"digest": "c7"},
        )
    ),
    ("replication", [replace(REPLICATED, alone=REPLACED)], Ruling.UNTESTABLE),
]


@pytest.mark.parametrize(("name", "found", "ruling"), RULINGS)
def test_a_rule_gives_each_of_its_rulings(name: str, found: Any, ruling: Ruling) -> None:
    verdict = rule_on(name, *found)
    assert verdict.ruling is ruling
    is_met = (name, ruling) == ("context-switch", BOUNDED) or ruling is HOLDS
    assert (describe_unmet(verdict.checks) == "") == is_met


def test_unmet_comparisons_are_described_with_their_values() -> None:
    unmet = describe_unmet(rule_on("context-switch", switch(8.0)).checks)
    assert unmet == "switch_p99_us 9, not <= 8"


def test_a_claim_without_results_shows_the_reason() -> None:
    lacking = StoredResult({}, 1.0, "now", "this machine has one processor")
    for results, ruling, why in (
        ({}, Ruling.UNMADE, "nasrem: not run yet"),
        ({"nasrem": "the rack did not run"}, Ruling.UNMADE, "nasrem: the rack did not run"),
        ({"nasrem": lacking}, Ruling.UNTESTABLE, "this machine has one processor"),
    ):
        judged = CLAIMS["equation-3.1"].judge_results(results)
        assert (judged.ruling, judged.why) == (ruling, why)
        assert judged.predicted
