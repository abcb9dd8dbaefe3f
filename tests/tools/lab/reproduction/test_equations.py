"""Equations 3.1 to 3.10 on the page: predicted, judged by a run, and a rack in which each fails."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from rack.levels.timing.verdicts import EquationVerdict
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.nasrem import (
    NASREM,
    MeasuredVerdict,
    NasremRun,
    Percentiles,
    SystemResponse,
    WayResponse,
)
from rack.tools.lab.reproduction.sections import timing
from rack.tools.lab.reproduction.sections.equations import PaperEquation
from rack.tools.lab.reproduction.sections.page import Columns, Listing, Ruling

EQUATIONS = [one for one in vars(timing).values() if isinstance(one, PaperEquation)]
WAY = WayResponse(4.0, Percentiles(1.0, 2.0, 3.0), ())
RUN = NasremRun(
    *("task done", 800, {}, (), {}),
    SystemResponse(("task", "servo"), 4.0, 4.0, WAY, WAY),
    *((), {}),
)
NOWHERE = Workshop(Path("nowhere"), share=True)


def test_all_ten_equations_are_there_in_their_order() -> None:
    assert [one.number for one in EQUATIONS] == [f"3.{number}" for number in range(1, 11)]
    named = [
        s.name for chapter in (timing.RESPONSE, timing.LOW, timing.HIGH) for s in chapter.statements
    ]
    assert [name for name in named if name.startswith("equation")] == [
        f"equation-{one.number}" for one in EQUATIONS
    ]


@pytest.mark.parametrize("equation", EQUATIONS, ids=lambda one: one.number)
def test_each_fails_in_the_rack_that_is_to_show_it(equation: PaperEquation) -> None:
    _, shown = equation.failure()
    if isinstance(shown, Listing):
        assert re.search("60 Hz does not divide the 400 Hz clock", shown.text)
    else:
        assert isinstance(shown, Columns)
        assert any("FAILS" in row for row in shown.rows)


def verdict(holds: bool, mostly: bool) -> MeasuredVerdict:
    """Return a verdict as a run keeps it: one equation, measured for one level."""
    left = 1e6 if holds else 3e6
    measured = EquationVerdict("3.1", "servo", left, "<=", 2.5e6, holds, "")
    return MeasuredVerdict(measured, mostly)


@pytest.mark.parametrize(
    ("holds", "mostly", "ruling"),
    [(True, True, Ruling.HOLDS), (False, True, Ruling.BOUNDED), (False, False, Ruling.FAILS)],
    ids=["always", "mostly", "seldom"],
)
def test_an_equation_is_judged_by_the_worst_cycle_and_by_most(
    holds: bool, mostly: bool, ruling: Ruling
) -> None:
    run = NASREM.document(replace(RUN, verdicts=(verdict(holds, mostly),)))
    (fits, *_) = timing.RESPONSE.statements
    assert fits.tested({"nasrem": run}, NOWHERE).ruling is ruling
