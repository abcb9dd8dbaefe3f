"""Evidence that follows from configs alone."""

from __future__ import annotations

from rack.boards.config import load, rack_timing, wire
from rack.boards.errors import ConfigError
from rack.boards.timing.forecast import Forecast
from rack.tools.lab.reproduction.experiments.figures import FIG2, FigureRack
from rack.tools.lab.reproduction.experiments.nasrem import NAME
from rack.tools.lab.reproduction.page import Evidence
from rack.tools.lab.reproduction.rules import PAPER_X, check_equations, check_planning
from rack.tools.timing.charts import figure5


def predict_equation(number: str, config: str, settings: tuple[str, ...]) -> tuple[Evidence, ...]:
    """Return both sides of an equation in NASREM's rack, and in a rack in which it fails."""
    return _equation(number, NAME, ()), _equation(number, config, settings)


def _equation(number: str, config: str, settings: tuple[str, ...]) -> Evidence:
    """Return both sides by the budgets of a config, or why it is refused."""
    source = " ".join(("rack check", config, *(f"--set {one}" for one in settings)))
    try:
        found = load(config, settings)
        verdicts = Forecast.of(rack_timing(found, wire(found))).verdicts
    except ConfigError as error:
        return Evidence(source, text=str(error))
    return Evidence(source, tuple(check_equations(v for v in verdicts if v.equation == number)))


def predict_figure(figure: FigureRack) -> tuple[Evidence, ...]:
    """Return a figure as the paper draws it, in letters."""
    return (Evidence(f"rack gantt {figure.config}", text=figure.letters(figure.panel())),)


def predict_sweep() -> tuple[Evidence, ...]:
    """Return what the paper says of figure 2's planner for every X that it permits."""
    checks = (check for process_ms in PAPER_X for check in check_planning(process_ms))
    return (Evidence(FIG2.config, tuple(checks)),)


def predict_figure_5() -> tuple[Evidence, ...]:
    """Return NASREM's levels in figure 5."""
    text = "\n".join(figure5.lines(load(NAME)))
    return (Evidence(f"rack gantt {NAME} --figure 5", text=text),)
