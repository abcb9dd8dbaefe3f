"""`rack check`: validate a config, show what it makes, and predict whether its levels meet their cycles."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rack.tools.console.answer import ConfigName, Failure, Faults, Json, Settings, print_json

if TYPE_CHECKING:
    from rack.boards.config import RackConfig
    from rack.tools.timing.repair import Repair

From = Annotated[
    Path | None,
    typer.Option("--from", metavar="RUN", help="budgets as this run of the rack has measured them, not the config's"),
]
Percentile = Annotated[
    float,
    typer.Option(
        metavar="P", min=0.0, max=100.0, help="with --from: the worst of P in 100 cycles, as a host may stall some"
    ),
]
Fix = Annotated[
    bool, typer.Option("--fix", help="print the config with the cheapest changes that make it fit, and nothing else")
]


def check(
    config: ConfigName,
    settings: Settings = [],  # noqa: B006  typer copies it
    faults: Faults = None,
    run: From = None,
    percentile: Percentile = 100.0,
    fix: Fix = False,
    as_json: Json = False,
) -> None:
    """Validate a config, show what it makes, and predict its timing.

    Slots, cores, rates, mailboxes with their bus addresses; or every mistake, one a line.
    On a terminal the tables show as many columns as fit; --json has all.

    The timing comes from budgets, the longest that each part of a level's cycle may take, as processor time:
    [board.<name>.budget] in the config, with read_ms (R), process_ms (X), write_ms (W), exchange_ms (C, reading the
    plan), plan_ms (P), update_ms (U), and plan_within_ms, how soon a new plan is wanted; or measured, with --from RUN.
    [timing] holds t_cs (context_switch_ms), the clock's time (clock_ms), what is small in eq. 3.10 (small_share), and a
    goal for the system's response (response_ms).

    Every equation of the paper, 3.1 to 3.10, is put to every level that has a budget: both sides, the margin, ok or
    FAILS. Beyond the paper: the worst-case response time of every task among those on its core, and the core's load.

    Where something fails it says what would do, each change tried on the whole rack, the cheapest first: another
    priority or core, a planner on a board of its own, older plans, a longer cycle, of that board or of one that shares
    its core; last what needs a core that this machine lacks. --fix prints the config with the first.

    Exit status: 0 all holds, or there is nothing to judge; 1 an equation fails, or nothing helps; 2 a bad config.

    Examples: rack check fig3; rack check fig3 --fix > fits.toml; rack check nasrem --from runs/nasrem-20250101-120000
    """
    from rack.boards.config import budgets, load, shared_out
    from rack.tools.console.tables import print_wrapped, terminal_width
    from rack.tools.inventory import Inventory
    from rack.tools.timing.forecast import Forecast
    from rack.tools.timing.repair import repair
    from rack.tools.timing.trial import Trial

    found = load(config, settings, faults)
    if run is not None:
        found = _measured(found, run, percentile)
    trial = Trial.of(found, budgets(found))
    if trial.failing and sys.stderr.isatty():
        print("something fails; looking for what would do", file=sys.stderr)
    fitting = repair(trial)
    if fix:
        _print_fixed(fitting, as_json)
        sys.exit(1 if fitting.left else 0)
    inventory, forecast = Inventory.of(found, trial.layout, shared_out(found)), Forecast.of(trial)
    if as_json:
        print_json(inventory.document() | {"timing": forecast.document() | {"repair": fitting.document()}})
    else:
        width = terminal_width()
        print_wrapped("\n".join([*inventory.lines(width), *forecast.lines(width), "", *fitting.lines()]))
    sys.exit(0 if forecast.holds else 1)


def _measured(config: RackConfig, run: Path, percentile: float) -> RackConfig:
    """Return a config with the budgets that a run has measured. Raises `Failure` for a run of another rack."""
    from rack.boards.config.timing import with_budgets
    from rack.tools.recording import Recording
    from rack.tools.timing.measured import measured_budgets

    recording = Recording(run)
    ran, asked = sorted({task.board for task in recording.layout.tasks}), sorted(config.board)
    if ran != asked:
        raise Failure(f"{run}: a run of other boards: {', '.join(ran)}; '{config.name}' has {', '.join(asked)}", 2)
    return with_budgets(config, measured_budgets(recording, percentile))


def _print_fixed(fitting: Repair, as_json: bool) -> None:
    """Print the config that fits on stdout, what was changed on stderr."""
    document = fitting.document()
    if as_json:
        print_json(document | {"config": None if fitting.left else fitting.end.config.text()})
        return
    print(*(fitting.lines() or ["nothing to change"]), sep="\n", file=sys.stderr)
    if not fitting.left:
        print(fitting.end.config.text(), end="")
