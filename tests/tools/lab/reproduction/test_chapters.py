"""The page as a whole: every section, equation and figure of the paper is on it, and every ruling
has its reason."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from rack.tools.console.answer import Failure
from rack.tools.lab.reproduction.experiments.deadline import DEADLINE, GotoRun, GotoRuns
from rack.tools.lab.reproduction.experiments.determinism import (
    DETERMINISM,
    ComparedRun,
    ComparedRuns,
)
from rack.tools.lab.reproduction.experiments.experiment import KEPT, Experiment, Found, Workshop
from rack.tools.lab.reproduction.experiments.figures import LEVEL, PLANNER, FigureRun
from rack.tools.lab.reproduction.experiments.partition import (
    PARTITION,
    LevelFigures,
    PartitionFigures,
    Partitions,
    TaskFigures,
)
from rack.tools.lab.reproduction.experiments.sharing import (
    CHAINS,
    ChainRun,
    Chains,
)
from rack.tools.lab.reproduction.experiments.switch import SWITCH, SwitchCost, SwitchRun
from rack.tools.lab.reproduction.experiments.tables import TABLES, FiredRow, TableRun, TableRuns
from rack.tools.lab.reproduction.experiments.tasks import NetworkRun
from rack.tools.lab.reproduction.reproduction import CHAPTERS, chapters_named, experiments, forget
from rack.tools.lab.reproduction.sections import application, model, opening, timing
from rack.tools.lab.reproduction.sections.page import (
    DONE,
    Assessment,
    Chapter,
    Ruling,
)
from rack.tools.lab.reproduction.sections.sharing import judge_background, judge_loose
from rack.tools.recording.divergence import Difference
from rack.tools.timing.charts.panel import Count

SECTIONS = ["abstract", "1", "2", "3", "3.1", "3.2", "3.3", "3.4", "4", "4.1", "5"]
NOWHERE = Workshop(Path("nowhere"), share=True)


def test_every_section_equation_and_figure_of_the_paper_is_on_the_page_in_its_order() -> None:
    assert [chapter.name for chapter in CHAPTERS] == SECTIONS
    names = [statement.name for chapter in CHAPTERS for statement in chapter.statements]
    assert len(names) == len(set(names))
    assert [name for name in names if name.startswith("equation-")] == [
        f"equation-3.{n}" for n in range(1, 11)
    ]
    assert {f"figure-{n}" for n in range(1, 6)} <= set(names)


def test_no_two_experiments_share_a_name_or_a_picture() -> None:
    found = experiments(CHAPTERS)
    assert len({one.name for one in found}) == len(found)
    assert sum(one.seconds for one in found) < 15 * 60


def test_a_section_that_the_paper_lacks_is_refused() -> None:
    with pytest.raises(Failure, match=r"--only 6: no such section; permitted: abstract, 1, 2"):
        chapters_named(["6"])


def judged(chapter: Chapter, name: str, experiment: Experiment[Found], found: Found) -> Assessment:
    """Return the judgement of one statement of a chapter, by a result as it is read from its
    file."""
    (statement,) = [one for one in chapter.statements if one.name == name]
    kept = json.loads(json.dumps(experiment.document(found)))
    return statement.tested({experiment.name: kept}, NOWHERE)


def run(mode: str, digest: str, miss: int | None = None, differs: int | None = None) -> ComparedRun:
    """Return what a run leaves of which the digest counts."""
    difference = None if differs is None else Difference(differs, "servo.status")
    return ComparedRun(mode, mode, digest, 1.0, 5, int(miss is not None), miss, difference)


LOCKSTEP = [run("lockstep", "a"), run("lockstep", "a")]


@pytest.mark.parametrize(
    ("runs", "ruling"),
    [
        ([*LOCKSTEP, run("realtime", "a")], Ruling.HOLDS),
        ([*LOCKSTEP, run("realtime", "b", miss=4, differs=5), run("realtime", "a")], Ruling.HOLDS),
        ([*LOCKSTEP, run("realtime", "b", miss=4, differs=5)], Ruling.BOUNDED),
        ([*LOCKSTEP, run("realtime", "b", miss=6, differs=5)], Ruling.FAILS),
        ([*LOCKSTEP, run("realtime", "b", differs=5)], Ruling.FAILS),
        (
            [run("lockstep", "a"), run("lockstep", "b", differs=1), run("realtime", "a")],
            Ruling.FAILS,
        ),
    ],
    ids=[
        "equal",
        "equal at last",
        "after a miss",
        "before a miss",
        "without a miss",
        "lockstep differs",
    ],
)
def test_determinism_is_judged_by_digests_and_by_the_first_miss(
    runs: list[ComparedRun], ruling: Ruling
) -> None:
    found = ComparedRuns(tuple(runs))
    assert judged(opening.ABSTRACT, "determinism", DETERMINISM, found).ruling is ruling


@pytest.mark.parametrize(
    ("lockstep", "realtime", "ruling"),
    [
        ({5: 9}, {5: 9}, Ruling.HOLDS),
        ({5: 9}, {5: 98, 6: 2}, Ruling.BOUNDED),
        ({5: 9}, {5: 8, 6: 1}, Ruling.FAILS),
        ({5: 8, 6: 1}, {5: 9}, Ruling.FAILS),
        ({5: 9}, {4: 1, 5: 8}, Ruling.FAILS),
    ],
    ids=["exact", "stray", "often late in real time", "late in lockstep", "too early"],
)
def test_five_levels_take_five_cycles(
    lockstep: dict[int, int], realtime: dict[int, int], ruling: Ruling
) -> None:
    empty = ChainRun(5, 9, 0, {})
    exact, real = (replace(empty, took=took) for took in (lockstep, realtime))
    found = Chains(exact, real, empty, empty)
    assert judged(model.CHAPTER, "pipeline", CHAINS, found).ruling is ruling


@pytest.mark.parametrize(
    ("refused", "done_s", "ruling"),
    [(True, 9.9, Ruling.HOLDS), (True, 10.2, Ruling.FAILS), (False, 9.9, Ruling.FAILS)],
    ids=["met", "too late", "not refused"],
)
def test_a_time_is_refused_or_met(refused: bool, done_s: float, ruling: Ruling) -> None:
    soft = GotoRun(None, 9.0, None, True, "task done", "")
    early = replace(soft, by_s=4.0, done_s=None if refused else 5.0, moved=not refused)
    met = replace(soft, by_s=10.0, done_s=done_s)
    found = GotoRuns((0.0, 0.0, 0.0), soft, early, met)
    assert judged(timing.SOFT, "soft-and-real-time", DEADLINE, found).ruling is ruling


def test_state_tables_must_answer_the_disturbance() -> None:
    def task(*rows: str, worked: bool = True) -> TableRun:
        fired = tuple(FiredRow(name, 1, 1.0) for name in rows)
        return TableRun({"elemental_move": fired}, worked)

    calm, answered = task("pick"), task("pick", "aim again")
    for disturbed, ruling in (
        (answered, Ruling.HOLDS),
        (calm, Ruling.FAILS),
        (replace(answered, worked=False), Ruling.FAILS),
    ):
        found = TableRuns(disturbed, calm)
        assert judged(application.CHAPTER, "state-tables", TABLES, found).ruling is ruling


@pytest.mark.parametrize(
    ("late", "blocks", "in_line", "ruling"),
    [
        (0, 9, 99, Ruling.HOLDS),
        (2, 9, 99, Ruling.BOUNDED),
        (3, 9, 99, Ruling.FAILS),
        (0, 0, 99, Ruling.FAILS),
        (0, 9, 9, Ruling.FAILS),
    ],
    ids=["in time", "stray", "late", "nothing stored", "in time in the cycle, too"],
)
def test_background_work_is_done_and_makes_no_cycle_late(
    late: int, blocks: int, in_line: int, ruling: Ruling
) -> None:
    behind, line = (
        FigureRun({LEVEL: Count(100, bad), PLANNER: Count(blocks, 0)}, (), {}, 0, 0, {})
        for bad in (late, in_line)
    )
    assert judge_background(behind, line).ruling is ruling


@pytest.mark.parametrize(
    ("missed", "response_ms", "ended", "ruling"),
    [
        (0.0, 150.0, DONE, Ruling.HOLDS),
        (0.01, 150.0, DONE, Ruling.BOUNDED),
        (0.03, 150.0, DONE, Ruling.FAILS),
        (0.0, 60.0, DONE, Ruling.FAILS),
        (0.0, 250.0, DONE, Ruling.FAILS),
        (0.0, None, DONE, Ruling.FAILS),
        (0.0, 150.0, "time over", Ruling.FAILS),
    ],
    ids=["follows", "stray", "late servo", "too early", "too late", "no response", "undone"],
)
def test_a_slower_network_delays_the_response_and_no_servo_cycle(
    missed: float, response_ms: float | None, ended: str, ruling: Ruling
) -> None:
    plain = NetworkRun(DONE, 8.0, 0.0, {}, 0.0, 50.0)
    later = replace(plain, ended=ended, servo_missed=missed, response_ms=response_ms)
    assert judge_loose(plain, later).ruling is ruling


TIMES = {"min": 4.0, "p50": 5.0, "p99": 9.0, "p99_9": 9.0, "max": 12.0}


def test_the_context_switch_is_compared_with_the_papers() -> None:
    cost = SwitchCost(1, 1000, TIMES, TIMES, TIMES)
    tested = judged(application.CHAPTER, "context-switch", SWITCH, SwitchRun(cost, 50.0))
    assert tested.ruling is Ruling.BOUNDED
    assert "takes 5 us, 20.0 times less" in tested.why
    tested = judged(application.CHAPTER, "context-switch", SWITCH, SwitchRun(cost, 8.0))
    assert tested.ruling is Ruling.FAILS
    assert "99th percentile, the config's: 9 us, demanded ≤ 8 us" in tested.why


@pytest.mark.parametrize(
    ("slow", "fast", "plans", "ruling"),
    [
        (0, 0, 1, Ruling.BOUNDED),
        (0, 50, 1, Ruling.HOLDS),
        (50, 50, 1, Ruling.FAILS),
        (0, 50, 0, Ruling.UNTESTABLE),
    ],
    ids=["nobody needs more", "fast levels need more", "slow levels need more", "no plan"],
)
def test_partitions_are_judged_by_what_slow_and_fast_levels_miss(
    slow: int, fast: int, plans: int, ruling: Ruling
) -> None:
    def figures(partition: str, missed: dict[str, int]) -> PartitionFigures:
        planner = TaskFigures(plans, 0, 0, None)
        levels = (
            LevelFigures(level, TaskFigures(100, bad, 0, None), planner, None)
            for level, bad in missed.items()
        )
        return PartitionFigures(partition, tuple(levels), {0: 0.5})

    tight = figures("tight, 1 core", {"task": slow, "servo": fast})
    loose = figures("loose, 2 cores", {"task": slow, "servo": 0})
    found = Partitions(4.0, (tight, loose))
    assert judged(application.CHAPTER, "figure-5", PARTITION, found).ruling is ruling


def test_what_was_not_made_or_cannot_be_is_said_in_place(tmp_path: Path) -> None:
    from rack.tools.lab.reproduction.experiments.experiment import Kept

    workshop = Workshop(tmp_path, share=True)
    workshop.prepare()
    (statement,) = timing.SOFT.statements
    unmade = statement.claim(workshop, {})
    failed = statement.claim(workshop, {"goto": "the rack did not run"})
    lacking = statement.claim(
        workshop, {"goto": Kept({}, 1.0, "now", "this machine has one processor")}
    )
    assert (unmade.tested.ruling, failed.tested.ruling) == (Ruling.UNMADE, Ruling.UNMADE)
    assert "the rack did not run" in failed.tested.why
    assert lacking.tested.ruling is Ruling.UNTESTABLE
    assert lacking.tested.why == "this machine has one processor."
    assert all(claim.predicted for claim in (unmade, failed, lacking))


def test_a_section_is_made_again_when_it_is_forgotten(tmp_path: Path) -> None:
    (tmp_path / KEPT).mkdir()
    for name in ("goto", "nasrem"):
        (tmp_path / KEPT / f"{name}.json").touch()
    forget(chapters_named(["3"]), tmp_path)
    assert [path.name for path in (tmp_path / KEPT).iterdir()] == ["nasrem.json"]
