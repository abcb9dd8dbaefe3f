"""Section 5 of the paper: predictable response."""

from __future__ import annotations

from pathlib import Path

from rack.boards.config import load
from rack.tools.lab.reproduction.experiments.experiment import Workshop
from rack.tools.lab.reproduction.experiments.measured import NAME, RESPONSE
from rack.tools.lab.reproduction.sections.equations import forecast_of
from rack.tools.lab.reproduction.sections.page import Assessment, Columns, Plate, Ruling, Side, code
from rack.tools.lab.reproduction.sections.statement import Chapter, Findings, Statement


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
    rows = [
        (
            row.level,
            row.commands,
            f"{row.min_ms:g}",
            f"{row.median_ms:g}",
            f"{row.max_ms:g}",
            f"{row.longest_ms:g}",
            f"{row.sum_eq_3_3_ms:g}",
            f"{row.bound_eq_3_2_ms:g}",
            f"{row.max_from_reading_ms:g}",
            row.off_prediction,
        )
        for row in found.levels
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
    side: Side = [
        Columns(head, rows, caption),
        Plate(
            Path(found.pictures["response"]),
            "Responses to commands at each level, with their bounds.",
        ),
    ]
    if found.held and all(twin.agrees for twin in found.twins):
        why = (
            f"All {found.measured} commands took effect at the predicted tick and within the"
            " bounds of equations 3.2 and 3.3. In a run without one of them, the torque is the"
            " same until that tick, bit for bit."
        )
        return Assessment(side, Ruling.HOLDS, why)
    why = (
        f"{found.beyond} responses beyond a bound, {found.off_prediction} not at the"
        " predicted tick."
    )
    return Assessment(side, Ruling.FAILS, why)


CHAPTER = Chapter(
    "5",
    (Statement("predictable-response", (RESPONSE,), _predictable, _predictable_tested),),
)
