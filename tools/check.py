"""`rack check`: validate a config, show its inventory, and predict whether its levels meet their cycles."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rack.tools.answer import ConfigName, Failure, Faults, Json, Settings, print_json

if TYPE_CHECKING:
    from rack.boards.config import RackConfig
    from rack.tools.timing.repair import Repair

From = Annotated[
    Path | None,
    typer.Option("--from", metavar="RUN", help="budgets measured in this run of the rack, instead of the config's"),
]
Percentile = Annotated[
    float,
    typer.Option(
        metavar="P",
        min=0.0,
        max=100.0,
        help="with --from: the worst of P in 100 cycles, without those that the host stalled",
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
    """Validate a config, show its inventory, and predict its timing.

    Prints slots, cores, rates, and mailboxes with their bus addresses; or every mistake, one per line.
    On a terminal the tables show as many columns as fit; --json has all.

    The timing rests on budgets, the longest processor time of each part of a level's cycle: [board.<name>.budget] in
    the config, with read_ms (R), process_ms (X), write_ms (W), exchange_ms (C, reading the plan), plan_ms (P),
    update_ms (U), and plan_within_ms, a limit on the time to a new plan; or measured, with --from RUN. [timing] holds
    t_cs (context_switch_ms), the clock's time (clock_ms), the limit of eq. 3.10 (small_share), and a goal for the
    system's response (response_ms).

    Every equation of the paper, 3.1 to 3.10, is applied to every level that has a budget: both sides, the margin, ok or
    FAILS. Beyond the paper: every task's worst-case response time on its core, and the load of every core.

    If something fails, it lists changes that help, cheapest first, each tried on the whole rack: another priority or
    core, a board for the planner, older plans, a longer cycle, of that board or of one that shares its core; last,
    changes that need a core that this machine lacks. --fix prints the config with the first of them.

    Exit status: 0 everything holds, or nothing can be judged; 1 an equation fails, or no change helps; 2 a bad config.

    Examples: rack check fig3; rack check fig3 --fix > fits.toml; rack check nasrem --from runs/nasrem-20250101-120000
    """
    from rack.boards.config import load, shared_out
    from rack.levels.timing.forecast import Forecast
    from rack.tools.inventory import inventory, inventory_lines
    from rack.tools.live_table import print_wrapped, terminal_width
    from rack.tools.timing.judged_config import JudgedConfig
    from rack.tools.timing.repair import repair
    from rack.tools.timing.tables import forecast_lines

    found = load(config, settings, faults)
    if run is not None:
        found = _measured(found, run, percentile)
    judged = JudgedConfig.of(found)
    if judged.failing and sys.stderr.isatty():
        print("the timing does not fit; looking for changes that help", file=sys.stderr)
    fitting = repair(judged)
    if fix:
        _print_fixed(fitting, as_json)
        sys.exit(1 if fitting.left else 0)
    lacking = shared_out(found)
    stock, forecast = inventory(found, judged.layout, lacking), Forecast.of(judged.timing, not lacking)
    if as_json:
        print_json(stock | {"timing": forecast.document() | {"repair": fitting.document()}})
    else:
        width = terminal_width()
        lines = [*inventory_lines(stock, width), *forecast_lines(forecast, width), "", *fitting.lines()]
        print_wrapped("\n".join(lines))
    sys.exit(0 if forecast.holds else 1)


def _measured(config: RackConfig, run: Path, percentile: float) -> RackConfig:
    """Return a config with the budgets measured in a run. Raises `Failure` for a run of another rack."""
    from rack.boards.config.timing import with_budgets
    from rack.tools.analysis.measured_budgets import measured_budgets
    from rack.tools.recording import Recording

    recording = Recording(run)
    ran, asked = sorted({task.board for task in recording.layout.tasks}), sorted(config.board)
    if ran != asked:
        raise Failure(f"{run}: a run of other boards: {', '.join(ran)}; '{config.name}' has {', '.join(asked)}", 2)
    return with_budgets(config, measured_budgets(recording, percentile))


def _print_fixed(fitting: Repair, as_json: bool) -> None:
    """Print the config that fits on stdout, its changes on stderr."""
    document = fitting.document()
    if as_json:
        print_json(document | {"config": None if fitting.left else fitting.end.config.text()})
        return
    print(*(fitting.lines() or ["nothing to change"]), sep="\n", file=sys.stderr)
    if not fitting.left:
        print(fitting.end.config.text(), end="")
