"""Section 5 of the paper: predictable response."""

from __future__ import annotations

from rack.boards.config import load
from rack.tools.lab.reproduction.experiments.experiment import PICTURES, Workshop
from rack.tools.lab.reproduction.experiments.response import (
    NAME,
    RESPONSE,
    ResponseFigures,
    ResponseRun,
)
from rack.tools.lab.reproduction.sections.equations import forecast_of
from rack.tools.lab.reproduction.sections.page import (
    Chapter,
    ClaimVerdict,
    Columns,
    Plate,
    Requirement,
    Row,
    Side,
    Statement,
    code,
    ruled,
)
from rack.tools.timing.operator_response import plot

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


def _predictable_measured(workshop: Workshop, found: ResponseRun) -> Side:
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
    about = (
        "Holds and resumes at random ticks, in lockstep; ms from giving a command to the end of the"
        " cycle that acts."
    )
    drawn = workshop.shown(plot(found.realtime.response, workshop.folder / PICTURES))
    return [
        Columns(head, _response_rows(found.lockstep), about),
        Columns(head, _response_rows(found.realtime), "The same in real time."),
        Plate(drawn, "Responses in real time to commands at each level, with their bounds."),
    ]


def _response_rows(found: ResponseFigures) -> list[Row]:
    return [
        (
            row["level"],
            row["commands"],
            *(f"{row[name]:g}" for name in TIMES),
            row["off_prediction"],
        )
        for row in found.response.rows()
    ]


def judge_predictable(found: ResponseRun) -> ClaimVerdict:
    """Compare responses with the tick predicted, and with equations 3.2 and 3.3; within bounds,
    with the longest that the grid permits instead of the sum of eq. 3.3."""
    exact = found.lockstep
    real = found.realtime.response
    twins = sum(not twin.agrees for twin in exact.twins)
    always = [
        Requirement("lockstep: not at the predicted tick", len(exact.response.off), "=", 0),
        Requirement("lockstep: torque changed at another tick", twins, "=", 0),
    ]
    bounds = [
        [
            Requirement(
                f"{row['level']}, {name}", row["max_from_reading_ms"], "<=", row[bound], "ms"
            )
            for row in real.rows()
            if row["commands"]
        ]
        for name, bound in (("eq. 3.2", "bound_eq_3_2_ms"), ("eq. 3.3", "sum_eq_3_3_ms"))
    ]
    waits = Requirement("real time: beyond the longest on the grid", len(real.beyond), "=", 0)
    why = (
        f"All {len(exact.response.measured)} commands in lockstep took effect at the predicted"
        f" tick, all {len(real.measured)} in real time within equations 3.2 and 3.3. Runs without"
        f" one of them, of which the torque is the same until that tick: {len(exact.twins)}."
    )
    return ruled(
        (*always, *bounds[0], *bounds[1], waits),
        why,
        here=(*always, *bounds[0], waits),
        needs=(Requirement("commands in real time", len(real.measured), ">=", 1),),
    )


CHAPTER = Chapter(
    "5",
    (
        Statement(
            "predictable-response",
            (RESPONSE,),
            judge_predictable,
            _predictable,
            _predictable_measured,
        ),
    ),
)
