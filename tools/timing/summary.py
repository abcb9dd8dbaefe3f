"""Summary of a check.

It states whether the rack fits, its smallest margin, its response time, the abilities of its arm,
and the changes that would make it fit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from rack.boards.timing.forecast import NO_BUDGET, Forecast
from rack.boards.timing.verdicts import EQUATIONS, EquationVerdict
from rack.tools.console.tables import Blocks
from rack.tools.timing.repair import Repair
from rack.tools.timing.tables import build_verdict_table, format_side

if TYPE_CHECKING:
    # MuJoCo takes 0.5 s to import, therefore import it only for racks with an arm.
    from rack.levels.robot.abilities import Abilities

RESPONSES = "3.2", "3.3"
"""Equations of the response of the system."""


def format_summary(
    forecast: Forecast,
    fitting: Repair,
    arm: Abilities | None,
    joints: Sequence[str],
    measuring: str,
) -> Blocks:
    """Yield the summary as text for the terminal, with every verdict that fails.

    Args:
        forecast: Timing of the rack.
        fitting: Config changes with which the rack fits.
        arm: Abilities of the arm. None for a rack without one.
        joints: Names of the arm's joints.
        measuring: Command that measures budgets. Empty if they were measured.
    """
    yield from _format_verdict(forecast, measuring)
    failing = [verdict for verdict in forecast.verdicts if not verdict.holds]
    yield from find_tightest(forecast.verdicts)
    system = forecast.system
    if system.levels:
        yield (
            f"response: a command down {system.command_ms:g} ms, a status up"
            f" {system.status_ms:g} ms"
        )
    if arm is not None:
        yield (
            f"arm: its tool reaches {arm.reach:.2f} m, holds {arm.payload:.1f} kg at rest; gravity"
            f" leaves {arm.torque_left:.0%} of the torque of {joints[arm.joint]}"
        )
    if failing:
        yield ""
        yield build_verdict_table(("", verdict) for verdict in failing)
        yield ""
        yield from fitting.format_lines()
    elif not forecast.uncounted:
        yield "to do: nothing"
    yield from forecast.notes


def _format_verdict(forecast: Forecast, measuring: str) -> Iterator[str]:
    """Yield lines that say whether the rack fits, and what the verdict does not include."""
    names: dict[str, list[str]] = {}
    for name, why in forecast.uncounted.items():
        names.setdefault(why, []).append(f"'{name}'")
    left_out = ", ".join(f"{', '.join(boards)} ({why})" for why, boards in names.items())
    silent = names.get(NO_BUDGET)
    command = ""
    if silent and measuring:
        command = f": measure {'it' if len(silent) == 1 else 'them'} by: {measuring}"
    count = len(forecast.verdicts)
    if failing := sum(not verdict.holds for verdict in forecast.verdicts):
        exceptions = f"; not counted: {left_out}{command}" if left_out else ""
        yield f"does not fit: {failing} of {count} equations and bounds fail{exceptions}"
        return
    hold_text = f"all {count} equations and bounds hold; not counted: the recorder"
    if not forecast.rack.levels:
        yield f"fits, as far as is known: no board has a budget{command}"
    elif left_out:
        yield f"fits, without {left_out}{command}"
        yield hold_text
    else:
        yield f"fits: {hold_text}"


def find_tightest(verdicts: Sequence[EquationVerdict]) -> Iterator[str]:
    """Yield a line about the verdict with the smallest margin relative to its right side.

    Equalities are left out, because they have no margin, and so are the verdicts on the system
    response, because it is computed exactly.
    """
    bounds = [
        verdict
        for verdict in verdicts
        if verdict.sign != "=" and verdict.equation not in RESPONSES and verdict.right > 0.0
    ]
    if bounds:
        yield f"tightest: {_format_margin(min(bounds, key=lambda each: each.margin / each.right))}"


def _format_margin(verdict: EquationVerdict) -> str:
    """Format the margin of a verdict, such as "servo, eq. 3.1: 1 of 2.5 ms, 60% left"."""
    if verdict.endless:
        return verdict.endless
    criterion = verdict.equation
    if criterion in EQUATIONS:
        criterion = f"eq. {criterion}".replace("eq. fig.", "fig.")
    left_side = format_side(verdict.left, verdict.unit)
    right_side = format_side(verdict.right, verdict.unit)
    unit = " ms" if verdict.unit == "ns" else ""
    fraction = verdict.margin / verdict.right
    remainder = f"{fraction:.0%} left" if fraction >= 0.0 else f"{-fraction:.0%} too much"
    return f"{verdict.subject}, {criterion}: {left_side} of {right_side}{unit}, {remainder}"
