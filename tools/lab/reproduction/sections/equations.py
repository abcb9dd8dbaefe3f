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
from rack.tools.lab.reproduction.experiments.nasrem import NAME, NASREM, MeasuredVerdict, NasremRun
from rack.tools.lab.reproduction.sections.page import (
    Assessment,
    Columns,
    Findings,
    Listing,
    Row,
    Ruling,
    Side,
    Statement,
    code,
    text,
    wording,
)

SIGNS = {"<": "&lt;", "<=": "≤", "=": "="}
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
        self, tested: Callable[[PaperEquation, Findings], Assessment] | None = None
    ) -> Statement:
        """Return the equation as a statement, judged by `tested` or by all of its subjects in the
        run."""
        return Statement(self.name, (NASREM,), self.predicted, partial(tested or judged, self))

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


def judged(equation: PaperEquation, findings: Findings) -> Assessment:
    """Judge an equation by the worst cycle of every subject, and by 99 of 100 cycles."""
    found = findings.of(NASREM)
    verdicts = measured_of(equation.number, found)
    lasted = found.ticks * load(NAME).clock_ns * 1e-9
    words = (
        f"A run of {lasted:.1f} s in real time; each time is the longest of all cycles, without"
        " those of the start-up."
    )
    side: Side = [words, table_of(verdicts)]
    broken = text(", ".join(v.measured.subject for v in verdicts if not v.measured.holds))
    if not broken:
        return Assessment(
            side,
            Ruling.HOLDS,
            "It holds as predicted for every level, in the worst cycle of the run too.",
        )
    if all(verdict.mostly for verdict in verdicts):
        why = f"It holds as predicted in 99 of 100 cycles; in the worst it fails for {broken}. "
        if counts := found.breaches.get(equation.number):
            why += f"{counts} cycles broke it by their own numbers. "
        return Assessment(side, Ruling.BOUNDED, why + stolen(found))
    return Assessment(side, Ruling.FAILS, f"It fails for {broken}, in more than one of 100 cycles.")


def stolen(found: NasremRun) -> str:
    """Return how much of its cores the hypervisor took from a run."""
    if not found.steal:
        return "The hypervisor's share is not known."
    taken = ", ".join(f"{percent:g} % of core {core}" for core, percent in found.steal.items())
    return f"Meanwhile the hypervisor took {taken}."
