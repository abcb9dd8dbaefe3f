"""What a check says first: does the rack fit, where is it tightest, how soon does it respond, what
can its arm do, and what to do about it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from rack.boards.timing.forecast import NO_BUDGET, Forecast
from rack.boards.timing.verdicts import EQUATIONS, EquationVerdict
from rack.tools.console.tables import Blocks
from rack.tools.timing.repair import Repair
from rack.tools.timing.tables import side_text, verdict_table

if TYPE_CHECKING:
    # Importing MuJoCo takes 0.5 s: only racks with an arm pay for it.
    from rack.levels.robot.abilities import Abilities

RESPONSES = "3.2", "3.3"
"""Equations of the system's response."""


def summary_blocks(
    forecast: Forecast,
    fitting: Repair,
    arm: Abilities | None,
    joints: Sequence[str],
    measuring: str,
) -> Blocks:
    """Yield the summary as text for people, with every verdict that fails.

    Args:
        forecast: Timing of the rack.
        fitting: Changes that make it fit.
        arm: Abilities of the arm; None for a rack without one.
        joints: Names of the arm's joints.
        measuring: Command that measures budgets; empty if they were measured.
    """
    yield from _verdict(forecast, measuring)
    failing = [verdict for verdict in forecast.verdicts if not verdict.holds]
    yield from tightest(forecast.verdicts)
    system = forecast.system
    if system.levels:
        yield (
            f"response: a command down {system.command_ms:g} ms, a status up"
            f" {system.status_ms:g} ms"
        )
    if arm is not None:
        yield (
            f"arm: its tool reaches {arm.reach:.2f} m, holds {arm.payload:.1f} kg at rest; gravity"
            f" leaves {arm.left:.0%} of the torque of {joints[arm.joint]}"
        )
    if failing:
        yield ""
        yield verdict_table(("", verdict) for verdict in failing)
        yield ""
        yield from fitting.lines()
    elif not forecast.uncounted:
        yield "to do: nothing"
    yield from forecast.notes


def _verdict(forecast: Forecast, measuring: str) -> Iterator[str]:
    """Yield whether the rack fits, and whatever was not counted for that."""
    names: dict[str, list[str]] = {}
    for name, why in forecast.uncounted.items():
        names.setdefault(why, []).append(f"'{name}'")
    left_out = ", ".join(f"{', '.join(those)} ({why})" for why, those in names.items())
    silent = names.get(NO_BUDGET)
    command = ""
    if silent and measuring:
        command = f": measure {'it' if len(silent) == 1 else 'them'} by: {measuring}"
    count = len(forecast.verdicts)
    if failing := sum(not verdict.holds for verdict in forecast.verdicts):
        rest = f"; not counted: {left_out}{command}" if left_out else ""
        yield f"does not fit: {failing} of {count} equations and bounds fail{rest}"
        return
    held = f"all {count} equations and bounds hold; not counted: the recorder"
    if not forecast.rack.levels:
        yield f"fits, as far as is known: no board has a budget{command}"
    elif left_out:
        yield f"fits, without {left_out}{command}"
        yield held
    else:
        yield f"fits: {held}"


def tightest(verdicts: Sequence[EquationVerdict]) -> Iterator[str]:
    """Yield the verdict with the least part of its right side left; an equality has no margin, and
    the system's response is exact.
    """
    bounds = [
        found
        for found in verdicts
        if found.sign != "=" and found.equation not in RESPONSES and found.right > 0.0
    ]
    if bounds:
        yield f"tightest: {_margin(min(bounds, key=lambda found: found.margin / found.right))}"


def _margin(verdict: EquationVerdict) -> str:
    if verdict.endless:
        return verdict.endless
    what = verdict.equation
    if what in EQUATIONS:
        what = f"eq. {what}".replace("eq. fig.", "fig.")
    left = side_text(verdict.left, verdict.unit)
    right = side_text(verdict.right, verdict.unit)
    unit = " ms" if verdict.unit == "ns" else ""
    part = verdict.margin / verdict.right
    rest = f"{part:.0%} left" if part >= 0.0 else f"{-part:.0%} too much"
    return f"{verdict.subject}, {what}: {left} of {right}{unit}, {rest}"
