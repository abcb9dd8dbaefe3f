"""Predictions: evidence for claims that follows from configs alone."""

from __future__ import annotations

from rack.boards.config import build_rack_timing, load, resolve_layout
from rack.boards.errors import ConfigError
from rack.boards.timing.forecast import Forecast
from rack.tools.lab.reproduction.experiments.figures import FIG2, FigureRack
from rack.tools.lab.reproduction.experiments.nasrem import NAME
from rack.tools.lab.reproduction.page import Evidence
from rack.tools.lab.reproduction.rules import PAPER_X_MS, check_equations, check_planning
from rack.tools.timing.charts import figure5


def predict_equation(number: str, config: str, settings: tuple[str, ...]) -> tuple[Evidence, ...]:
    """Return both sides of an equation for NASREM's rack and for a rack that violates it.

    Args:
        number: Number of the equation, such as "3.4".
        config: Config of the rack that violates it.
        settings: Changes to this config, as for `--set`.
    """
    return _predict_for_config(number, NAME, ()), _predict_for_config(number, config, settings)


def _predict_for_config(number: str, config: str, settings: tuple[str, ...]) -> Evidence:
    """Return both sides of an equation from the budgets of a config, or the error in the config."""
    source = " ".join(("rack check", config, *(f"--set {setting}" for setting in settings)))
    try:
        rack = load(config, settings)
        verdicts = Forecast.from_rack(build_rack_timing(rack, resolve_layout(rack))).verdicts
    except ConfigError as error:
        return Evidence(source, text=str(error))
    return Evidence(source, tuple(check_equations(v for v in verdicts if v.equation == number)))


def predict_figure(figure: FigureRack) -> tuple[Evidence, ...]:
    """Return a figure in letters, as the paper draws it."""
    return (
        Evidence(f"rack gantt {figure.config}", text=figure.format_letters(figure.build_panel())),
    )


def predict_sweep() -> tuple[Evidence, ...]:
    """Return checks of the paper's statements on figure 2's planner for every permitted X."""
    checks = (check for process_ms in PAPER_X_MS for check in check_planning(process_ms))
    return (Evidence(FIG2.config, tuple(checks)),)


def predict_figure_5() -> tuple[Evidence, ...]:
    """Return figure 5 as text, with the levels of NASREM in their regions."""
    text = "\n".join(figure5.format_figure(load(NAME)))
    return (Evidence(f"rack gantt {NAME} --figure 5", text=text),)
