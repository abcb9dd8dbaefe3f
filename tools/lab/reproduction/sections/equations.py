"""Equations as statements: predicted for the NASREM rack, measured in its run, and a rack in which
each fails."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from math import isfinite

from rack.boards.config import RackConfig, load, rack_timing, wire
from rack.boards.errors import ConfigError
from rack.levels.timing.forecast import Forecast
from rack.levels.timing.verdicts import EquationVerdict
from rack.tools.console.tables import ms
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.nasrem import (
    MS,
    NAME,
    NASREM,
    MeasuredVerdict,
    NasremRun,
)
from rack.tools.lab.reproduction.sections.page import (
    SIGNS,
    ClaimVerdict,
    Columns,
    Listing,
    Requirement,
    Row,
    Side,
    Statement,
    code,
    ruled,
    text,
    wording,
)

HEAD = ("of", "left side", "", "right side", "margin", "")


def forecast_of(config: RackConfig) -> Forecast:
    """Return what the timing model predicts of a rack."""
    return Forecast.of(rack_timing(config, wire(config)))


def verdicts_of(config: RackConfig, equation: str) -> list[EquationVerdict]:
    """Return the predicted verdicts on one equation in a rack."""
    return [verdict for verdict in forecast_of(config).verdicts if verdict.equation == equation]


@dataclass(frozen=True)
class PaperEquation:
    """An equation of the paper by its number, and a config, with settings, in which it fails."""

    number: str
    config: str
    settings: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The name of its claim."""
        return f"equation-{self.number}"

    def statement(
        self,
        judged: Callable[[PaperEquation, NasremRun], ClaimVerdict] | None = None,
        further: Callable[[NasremRun], Side] = lambda found: [],
    ) -> Statement:
        """Return the equation as a statement, judged by `judged` or by all of its subjects in the
        run, of which the page shows `further` figures."""
        return Statement(
            self.name,
            (NASREM,),
            partial(judged or judge_equation, self),
            self.predicted,
            partial(_measured, self, further),
        )

    def predicted(self, workshop: Workshop) -> Side:
        """Return both sides for the NASREM rack by its budgets, and the rack in which the equation
        fails."""
        found = verdicts_of(load(NAME), self.number)
        meanings = "; ".join(dict.fromkeys(code(verdict.meaning) for verdict in found))
        words = f"{wording(self.name).reading} For {code(NAME)}, by the budgets of its config:"
        table = Columns(HEAD, [_row(verdict) for verdict in found])
        return [f"{words} {meanings}.", table, *self.failure()]

    def failure(self) -> tuple[str, Columns | Listing]:
        """Return the rack in which it fails in words, and what the timing model, or the check of
        the config, says of it."""
        given = " ".join(f"--set {setting}" for setting in self.settings)
        command = code(f"rack check {self.config} {given}".strip())
        words = f"Where it fails: {wording(self.name).failure} ({command})."
        try:
            found = verdicts_of(load(self.config, self.settings), self.number)
        except ConfigError as error:
            return words, Listing(str(error))
        return words, Columns(HEAD, [_row(verdict) for verdict in found])


def _row(verdict: EquationVerdict) -> Row:
    """Return a row of a table: subject, both sides, margin, and whether it holds."""
    holds = "ok" if verdict.holds else "FAILS"
    return (
        text(verdict.subject),
        _side(verdict.left, verdict.unit),
        SIGNS[verdict.sign],
        _side(verdict.right, verdict.unit),
        _side(verdict.margin, verdict.unit),
        holds,
    )


def _side(value: float, unit: str) -> str:
    if not isfinite(value):
        return "∞"
    return ms(value) if unit == "ns" else f"{value:.3g}"


def measured_of(equation: str, found: NasremRun) -> list[MeasuredVerdict]:
    """Return the measured verdicts on one equation."""
    return [verdict for verdict in found.verdicts if verdict.measured.equation == equation]


def table_of(verdicts: list[MeasuredVerdict]) -> Columns:
    """Return the measured verdicts as a table: the worst cycle of the run, and whether most cycles
    are better."""
    rows = [(*_row(verdict.measured), verdict.mostly) for verdict in verdicts]
    return Columns((*HEAD[:-1], "worst cycle", "in 99 of 100"), rows)


def _measured(
    equation: PaperEquation,
    further: Callable[[NasremRun], Side],
    workshop: Workshop,
    found: NasremRun,
) -> Side:
    lasted = found.ticks * load(NAME).clock_ns * 1e-9
    words = (
        f"A run of {lasted:.1f} s in real time; each time is the longest of all cycles, without"
        f" those of the start-up. {stolen(found)}"
    )
    return [words, table_of(measured_of(equation.number, found)), *further(found)]


def demands_of(equation: str, found: NasremRun) -> list[Requirement]:
    """Return what an equation demands of the worst cycle of every subject, ms where it is time."""
    return [
        Requirement(text(f"{one.subject}: {one.meaning}"), one.left, one.sign, one.right)
        if one.unit != "ns"
        else Requirement(
            text(f"{one.subject}: {one.meaning}"), one.left * MS, one.sign, one.right * MS, "ms"
        )
        for one in (verdict.measured for verdict in measured_of(equation, found))
    ]


def judge_equation(equation: PaperEquation, found: NasremRun) -> ClaimVerdict:
    """Compare both sides in the worst cycle of every subject; within bounds, in 99 of 100
    cycles."""
    verdicts = measured_of(equation.number, found)
    often = sum(not verdict.mostly for verdict in verdicts)
    return ruled(
        demands_of(equation.number, found),
        "It holds as predicted for every level, in the worst cycle of the run too.",
        needs=(Requirement("subjects measured", len(verdicts), ">=", 1),),
        here=(Requirement("subjects that fail in more than one of 100 cycles", often, "=", 0),),
    )


def stolen(found: NasremRun) -> str:
    """Return how much of its cores the hypervisor took from a run."""
    if not found.steal:
        return "The hypervisor's share is not known."
    taken = ", ".join(f"{percent:g} % of core {core}" for core, percent in found.steal.items())
    return f"Meanwhile the hypervisor took {taken}."
