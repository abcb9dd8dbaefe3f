"""Section 5 of the paper: predictable response."""

from __future__ import annotations

from rack.boards.config import load
from rack.tools.lab.reproduction.experiments.experiment import PICTURES, Workshop
from rack.tools.lab.reproduction.experiments.measured import NAME, RESPONSE
from rack.tools.lab.reproduction.sections.equations import forecast_of
from rack.tools.lab.reproduction.sections.page import (
    Assessment,
    Chapter,
    Columns,
    Findings,
    Plate,
    Ruling,
    Side,
    Statement,
    code,
)

TIMES = (
    "min_ms",
    "median_ms",
    "max_ms",
    "longest_ms",
    "sum_eq_3_3_ms",
    "bound_eq_3_2_ms",
    "max_from_reading_ms",
)
"""Times of a level's responses, in the order of the table."""


def _predictable(workshop: Workshop) -> Side:
    forecast = forecast_of(load(NAME))
    failing = [verdict for verdict in forecast.verdicts if not verdict.holds]
    return [
        f"By the budgets of {code(NAME)}, {len(forecast.verdicts) - len(failing)} of"
        f" {len(forecast.verdicts)} judgements of the timing model hold. It then predicts more than"
        " bounds: the tick at which the torque rests on a command that an operator gives at any"
        " tick, to any level."
    ]


def _predictable_tested(findings: Findings) -> Assessment:
    found = findings.of(RESPONSE)
    response = found.response
    rows = [
        (
            row["level"],
            row["commands"],
            *(f"{row[name]:g}" for name in TIMES),
            row["off_prediction"],
        )
        for row in response.rows()
    ]
    head = (
        "given to",
        "commands",
        "least",
        "median",
        "longest",
        "longest on the grid",
        "sum, 3.3",
        "bound, 3.2",
        "longest from its reading",
        "not at the predicted tick",
    )
    caption = (
        "Holds and resumes at random ticks, in lockstep; ms from giving a command to the end of the"
        " cycle that acts."
    )
    drawn = findings.workshop.shown(found.plot(findings.workshop.folder / PICTURES))
    side: Side = [
        Columns(head, rows, caption),
        Plate(drawn, "Responses to commands at each level, with their bounds."),
    ]
    if found.held:
        why = (
            f"All {len(response.measured)} commands took effect at the predicted tick and within"
            " the bounds of equations 3.2 and 3.3. In a run without one of them, the torque is the"
            " same until that tick, bit for bit."
        )
        return Assessment(side, Ruling.HOLDS, why)
    why = (
        f"{len(response.beyond)} responses beyond a bound, {len(response.off)} not at the"
        " predicted tick."
    )
    return Assessment(side, Ruling.FAILS, why)


CHAPTER = Chapter(
    "5",
    (Statement("predictable-response", (RESPONSE,), _predictable, _predictable_tested),),
)
