"""`rack check`: validate a config, show its inventory, and predict whether its levels meet their
cycles.
"""

from __future__ import annotations

import shlex
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from rack.boards.config import load, shared_out
from rack.boards.config.cell import built_cell
from rack.boards.config.schema import RackConfig
from rack.boards.config.timing import rack_timing, with_budgets, without_interrupts
from rack.boards.timing.forecast import Forecast
from rack.tools.console.answer import Failure, print_json
from rack.tools.console.parameters import ConfigName, Faults, Json, Settings, option
from rack.tools.console.tables import TextTable, print_blocks
from rack.tools.launch.folder import folder_of
from rack.tools.timing.inventory import arm_lines, inventory, inventory_blocks
from rack.tools.timing.judged_config import JudgedConfig
from rack.tools.timing.repair import Repair, repair
from rack.tools.timing.summary import summary_blocks
from rack.tools.timing.tables import forecast_blocks

if TYPE_CHECKING:
    from rack.levels.robot.abilities import Abilities


def check(
    config: ConfigName,
    settings: Settings = [],  # noqa: B006  typer copies it
    faults: Faults = None,
    run: Path | None = option(
        "--from RUN", "use the budgets measured in this run, not the config's"
    ),
    percentile: float = option(
        "--percentile P",
        "with --from: the longest of P in 100 cycles, to leave out cycles stalled by the host",
        100.0,
        min=0.0,
        max=100.0,
    ),
    fix: bool = option(
        "--fix", "print only the config, with the cheapest changes that make it fit", False
    ),
    verbose: bool = option(
        "--verbose",
        "add slots, mailboxes, every equation, and what an arm does while no torque comes",
        False,
    ),
    as_json: Json = False,
) -> None:
    r"""Validate a config, and predict whether its levels meet their cycles.

    It prints every mistake, one per line; or five lines: does the rack fit, where is it tightest,
    how soon does it respond, what can its arm do at rest, and what to do. --verbose adds slots,
    cores, rates, mailboxes with their bus addresses, and every equation. On a terminal the tables
    show as many columns as fit; --json has all.

    The timing rests on budgets: the longest processor time of each part of a level's cycle. They
    are in the config, in [board.<name>.budget], or measured, with --from RUN. [timing] has the
    context switch, the clock's own time, the limit of eq. 3.10, and a goal for the system's
    response. `rack schema board.budget` and `rack schema timing` show the keys.

    Equations 3.1 to 3.10 of the paper are applied to every level with a budget: both sides, the
    margin, and ok or FAILS. Beyond the paper, it computes the worst-case response time of every
    task, and the load of every core.

    If something fails, it lists changes that help, cheapest first, each tried on the whole rack:
    another priority or core, a board for the planner, older plans, or a longer cycle, of that board
    or of one that shares its core. Changes that need a core that this machine lacks come last.
    --fix prints the config with the first of them.

    The verdict names every board, planner and host board that was not counted: "fits" alone means
    that all were. The recorder never is. In --json timing.fits is true, false, or null for a rack
    that fits without what timing.uncounted lists.

    Exit status: 0 every equation holds, of what was counted; 1 an equation fails, or no change
    helps; 2 a bad config.

    \b
    Examples:
      rack check fig3
      rack check nasrem --verbose
      rack check fig3 --fix > fits.toml
      rack check nasrem --from runs/nasrem-20250101-120000
    """
    found = load(config, settings, faults)
    if run is not None:
        found = _measured(found, run, percentile)
    judged = JudgedConfig.of(found)
    if judged.failing and sys.stderr.isatty():
        print("the timing does not fit; looking for changes that help", file=sys.stderr)
    fitting = repair(judged)
    if fix:
        _print_fixed(fitting, as_json)
        if fitting.left:
            sys.exit(1)
        return
    lacking = shared_out(found)
    stock = inventory(found, judged.layout, lacking)
    forecast = Forecast.of(judged.timing, not lacking, found.host)
    arm = _abilities(found)
    if as_json:
        fits = (None if forecast.uncounted else True) if forecast.holds else False
        verdict = {"fits": fits, "uncounted": forecast.uncounted, "repair": fitting.document()}
        timing = forecast.document() | verdict
        arm_document = None if arm is None else asdict(arm)
        further = {"changed": found.changed, "arm": arm_document}
        print_json(stock | further | {"timing": timing})
    else:
        again = shlex.join([config, *(f"--set={setting}" for setting in settings)])
        measured = folder_of(None, found.name)
        measuring = (
            f"rack run {again} --seconds 10 --out {measured}; rack check {again} --from {measured}"
        )
        head, *rest = inventory_blocks(stock)
        lines: list[str | TextTable] = [
            head,
            *found.changed,
            *lacking,
            *summary_blocks(forecast, fitting, arm, found.joints, "" if run else measuring),
        ]
        if verbose:
            lines += [*rest[len(lacking) :], *arm_lines(stock), *forecast_blocks(forecast)]
        else:
            lines.append("--verbose shows every task, mailbox and equation")
        print_blocks(lines)
    if not forecast.holds:
        sys.exit(1)


def _measured(config: RackConfig, run: Path, percentile: float) -> RackConfig:
    """Return a config with the budgets measured in a run. Raises `Failure` for a run of another
    rack.
    """
    # Only --from needs them, and they take long to load.
    from rack.tools.recording.cycles import measured_budgets
    from rack.tools.recording.recording import Recording

    recording = Recording(run)
    ran = sorted({task.board for task in recording.layout.tasks})
    asked = sorted(config.board)
    if ran != asked:
        raise Failure(
            f"{run}: a run of other boards: {', '.join(ran)}; '{config.name}' has"
            f" {', '.join(asked)}",
            2,
        )
    ran_as = rack_timing(recording.rack_config, recording.layout)
    return with_budgets(config, without_interrupts(ran_as, measured_budgets(recording, percentile)))


def _abilities(config: RackConfig) -> Abilities | None:
    """Return what the arm of a rack can do at rest; None for a hand, or without one."""
    robot = config.robot
    if robot is None or robot.hand is not None:
        return None
    # Importing MuJoCo takes 0.5 s: only racks with an arm pay for it.
    from rack.levels.robot.abilities import abilities

    return abilities(built_cell(config))


def _print_fixed(fitting: Repair, as_json: bool) -> None:
    """Print the config that fits on stdout, its changes on stderr."""
    config = None if fitting.left else fitting.end.config.text()
    if as_json:
        print_json(fitting.document() | {"config": config})
        return
    print(*(fitting.lines() or ["nothing to change"]), sep="\n", file=sys.stderr)
    if config is not None:
        print(config, end="")
