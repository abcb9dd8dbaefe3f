"""Section 3.4 of the paper by computation: where figures 2 to 4 are what it says, and where they
are not."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.tools.lab.reproduction.experiments import figures
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.figures import (
    FigureRack,
    FigureRun,
    planning,
    sweep,
)
from rack.tools.lab.reproduction.predictions import predict_figure
from rack.tools.lab.reproduction.rules import PAPER_X, check_planning
from rack.tools.lab.reproduction.verdict import Ruling, describe_unmet
from rack.tools.timing.charts.panel import Count
from tests.tools.lab.reproduction.test_rules import rule_on

NEWER_X = 4.0
"""The X of the paper's newer version, ms."""


def test_the_contradiction_of_figure_2_is_found_by_computation() -> None:
    rows = {one.process_ms: one for one in sweep("fig2", PAPER_X)}
    # R X W P U in 8 ms: P has 5 - X ms a cycle, 2 ms with the longest X, not "at least 3 ms".
    assert {x: one.each_ms for x, one in rows.items()} == {x: 5 - x for x in (1, 1.5, 2, 2.5, 3)}
    assert [x for x, one in rows.items() if describe_unmet(check_planning(one))] == [2.5, 3.0]
    # With one U for each plan: 2 x 3 ms for P and U, which need 7.
    assert (rows[3.0].once_ms, rows[3.0].cycles_once, rows[3.0].permitted) == (3.0, 3, 2)
    assert rows[3.0].cycles_each == 3
    assert not rows[3.0].in_time
    assert "3.8" in rows[3.0].failing
    assert not rows[2.0].failing


def test_figure_3_has_a_plan_in_time_with_the_shortest_x() -> None:
    short, usual = planning("fig3", figures.LEAST_X), planning("fig3", 2.0)
    assert (short.in_time, short.failing) == (True, ())
    assert not usual.in_time
    assert "3.8" in usual.failing


def test_figure_4_has_no_idle_time_with_the_longest_x() -> None:
    usual, full, newer = (planning("fig4", x) for x in (2.0, figures.MOST_X, NEWER_X))
    assert (usual.pattern, usual.failing) == ("C R X W -", ())
    assert (full.pattern, full.failing, full.idle_ms) == ("C R X W", ("3.6",), 0.0)
    assert {"3.1", "3.6"} <= set(newer.failing)


def ran(late: int, jobs: int = 100) -> FigureRun:
    """Return what a run of a figure leaves, with so many late plans."""
    counts = {"level": Count(jobs), "level.planner": Count(jobs, late)}
    return FigureRun(counts, 0, 0, {"measured": Path("pictures/x.svg")})


FIGURES = [
    ("figure-2", (0,), Ruling.HOLDS),
    ("figure-2", (3,), Ruling.BOUNDED),
    ("figure-2", (97,), Ruling.FAILS),
    ("figure-4", (97,), Ruling.FAILS),
    ("figure-4-overload", (97,), Ruling.HOLDS),
    ("figure-4-overload", (3,), Ruling.FAILS),
    ("figure-3", (97, 97), Ruling.HOLDS),
    ("figure-3", (97, 0), Ruling.BOUNDED),
    ("figure-3", (0, 97), Ruling.FAILS),
    ("figure-2-x", (0, 100), Ruling.CONTRADICTS),
    # Runs that do not confirm the contradiction make it no finding.
    ("figure-2-x", (0, 0), Ruling.FAILS),
]


@pytest.mark.parametrize(("name", "late", "ruling"), FIGURES)
def test_a_figure_is_judged_by_its_runs(name: str, late: tuple[int, ...], ruling: Ruling) -> None:
    assert rule_on(name, *map(ran, late)).ruling is ruling


def test_a_schedule_is_drawn_as_the_paper_draws_it(tmp_path: Path) -> None:
    workshop = Workshop(tmp_path, share=True)
    workshop.prepare()
    (drawn,) = predict_figure(FigureRack("fig2", 2), workshop)
    assert (tmp_path / drawn.picture).read_text().startswith("<?xml")
    assert "RXXWPPPPRXXWPPU-" in drawn.text
