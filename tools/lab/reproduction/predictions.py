"""Evidence that follows from configs alone."""

from __future__ import annotations

from functools import cache

from rack.boards.config import load, rack_timing, wire
from rack.boards.errors import ConfigError
from rack.levels.timing.forecast import Forecast
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.figures import FIG2, FigureRack, sweep
from rack.tools.lab.reproduction.experiments.nasrem import NAME
from rack.tools.lab.reproduction.experiments.systems import SystemPrediction, prediction, systems
from rack.tools.lab.reproduction.page import Evidence
from rack.tools.lab.reproduction.rules import PAPER_X, check_equations, check_planning
from rack.tools.timing.charts import figure5
from rack.tools.timing.charts.letters import column_for, lines


def predict_equation(
    number: str, config: str, settings: tuple[str, ...], workshop: Workshop
) -> tuple[Evidence, ...]:
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


def predict_figure(figure: FigureRack, workshop: Workshop) -> tuple[Evidence, ...]:
    """Return a figure as the paper draws it, as letters and as a picture."""
    from rack.tools.timing.charts.picture import save

    panel = figure.panel()
    letters = lines(panel, column_for(figure.window_ns, figure.schedule().shortest_ns))
    drawn = workshop.shown(save([panel], figure.label, workshop.picture(figure.label)))
    source = f"rack gantt {figure.config}"
    return (Evidence(source, text="\n".join(letters), picture=str(drawn)),)


def predict_sweep(workshop: Workshop) -> tuple[Evidence, ...]:
    """Return what the paper says of figure 2's planner for every X that it permits."""
    checks = (check for one in sweep(FIG2.config, PAPER_X) for check in check_planning(one))
    return (Evidence(FIG2.config, tuple(checks)),)


def predict_figure_5(workshop: Workshop) -> tuple[Evidence, ...]:
    """Return NASREM's levels in figure 5."""
    drawn = workshop.shown(figure5.save(load(NAME), workshop.picture("figure5")))
    return (Evidence(f"rack gantt {NAME} --figure5", picture=str(drawn)),)


@cache
def promise_systems() -> dict[str, SystemPrediction]:
    """Return what the config of each system promises."""
    return {name: prediction(load(name)) for name in systems()}
