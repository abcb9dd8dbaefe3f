"""What a check says first: does the rack fit, where is it tightest, how soon does it respond, what
can its arm do, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from rack.levels.timing.forecast import Forecast
from rack.levels.timing.verdicts import EQUATIONS, EquationVerdict
from rack.tools.timing.repair import Repair
from rack.tools.timing.tables import side_text, verdict_table

if TYPE_CHECKING:
    # Importing MuJoCo takes 0.5 s: only racks with an arm pay for it.
    from rack.levels.robot.abilities import Abilities

RESPONSES = "3.2", "3.3"
"""Equations of the system's response."""


def summary_lines(
    forecast: Forecast, fitting: Repair, arm: Abilities | None, joints: Sequence[str]
) -> Iterator[str]:
    """Yield it as text for people, with every verdict that fails; `arm` is None where there is
    none."""
    failing = [verdict for verdict in forecast.verdicts if not verdict.holds]
    count = len(forecast.verdicts)
    if failing:
        yield f"does not fit: {len(failing)} of {count} equations and bounds fail"
    elif count:
        yield f"fits: all {count} equations and bounds hold"
    else:
        yield "fits, as far as is known: no board has a budget; --from RUN takes those measured"
    yield from tightest(forecast.verdicts)
    system = forecast.system
    if system.levels:
        down = system.command_ms
        up = system.status_ms
        yield f"response: a command down {down:g} ms, a status up {up:g} ms"
    if arm is not None:
        yield (
            f"arm: its tool reaches {arm.reach:.2f} m, holds {arm.payload:.1f} kg at rest; gravity"
            f" leaves {arm.left:.0%} of the torque of {joints[arm.joint]}"
        )
    if failing:
        yield ""
        yield from verdict_table(failing)
        yield ""
        yield from fitting.lines()
    else:
        yield "to do: nothing"
    yield from forecast.notes


def tightest(verdicts: Sequence[EquationVerdict]) -> Iterator[str]:
    """Yield the verdict with the least part of its right side left; an equality has no margin, and
    the system's response is exact."""
    bounds = [
        found
        for found in verdicts
        if found.sign != "=" and found.equation not in RESPONSES and found.right > 0.0
    ]
    if bounds:
        yield f"tightest: {_margin(min(bounds, key=lambda found: found.margin / found.right))}"


def _margin(verdict: EquationVerdict) -> str:
    what = verdict.equation
    if what in EQUATIONS:
        what = f"eq. {what}".replace("eq. fig.", "fig.")
    left = side_text(verdict.left, verdict.unit)
    right = side_text(verdict.right, verdict.unit)
    unit = " ms" if verdict.unit == "ns" else ""
    part = verdict.margin / verdict.right
    rest = f"{part:.0%} left" if part >= 0.0 else f"{-part:.0%} too much"
    return f"{verdict.subject}, {what}: {left} of {right}{unit}, {rest}"
