"""`rack check`: validate a config, and predict whether its levels meet their cycles."""

from __future__ import annotations

import shlex
import sys
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from rack.boards.config import list_replaced_cores, load
from rack.boards.config.cell import build_rack_cell
from rack.boards.config.files import name_config
from rack.boards.config.schema import RackConfig
from rack.boards.config.timing import build_rack_timing, replace_budgets, subtract_interrupts
from rack.boards.timing.forecast import Forecast
from rack.tools.console.answer import Failure, print_json
from rack.tools.console.parameters import ConfigName, Faults, Json, Settings, argument, option
from rack.tools.console.tables import TextTable, print_blocks
from rack.tools.launch.folder import choose_run_folder
from rack.tools.timing.inventory import build_inventory, format_arm_lines, format_inventory
from rack.tools.timing.judged_config import JudgedConfig
from rack.tools.timing.repair import Repair, find_repair
from rack.tools.timing.summary import format_fixes, format_summary, format_verdict
from rack.tools.timing.tables import format_forecast

if TYPE_CHECKING:
    from rack.levels.robot.abilities import Abilities

MAX_FIXES = 3
"""Largest number of proposed fixes."""


def check(
    config: ConfigName,
    others: list[str] = argument(
        "OTHER...", "configs of racks on the same network, to check the response across all", []
    ),
    settings: Settings = [],  # noqa: B006  typer copies it
    faults: Faults = None,
    run: Path | None = option(
        "--from RUN", "use the budgets measured in this run in place of the config's"
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
        "add slots, mailboxes, every equation, and the motion of an arm without new torques",
        False,
    ),
    as_json: Json = False,
) -> None:
    """Validate a config, and predict whether its levels meet their cycles.

    The command prints every mistake in the config, one per line. For a valid config it prints
    whether the rack fits, what is not counted, the load of each core with its busiest tasks, the
    smallest margin, the response time, reach and payload of the arm, and at most three fixes.
    --verbose adds slots, rates, mailboxes with their bus addresses, and every equation. The tables
    show as many columns as fit; --json has all.

    With several configs, the command checks each rack and the system response across all of them.
    A link between two racks counts as a level: its budget is delay_ms and max_lost of the import
    ([adapter.lan.import.<port>]). The options --from, --fix and --verbose take one config.

    The prediction uses budgets: the longest processor time of each part of a level's cycle. They
    are read from [board.<name>.budget] in the config, or measured in a run with --from RUN.
    [timing] contains the context switch time, the processor time of the clock, the limit of eq.
    3.10, and a goal for the system response. `rack schema board.budget` and `rack schema timing`
    show the keys.

    Equations 3.1 to 3.10 of the paper are evaluated for every level with a budget. The output shows
    both sides, the margin, and ok or FAILS. The command also computes the worst-case response time
    of every task and the load of every core, which the paper does not.

    If an equation fails, the command lists fixes, cheapest first, as options to append to it. The
    rack fits with any of them: another priority or core, a separate board for the planner, a
    larger plan age, or a longer cycle, for the failing board or for one that shares its core. Fixes
    that need more cores than this machine has come last. --fix prints the config with the first.

    The verdict names every board, planner and host board that was not counted. If it names none,
    all were counted except the recorder. With --json, timing.fits is true, false, or null if the
    rack fits when the boards in timing.uncounted are ignored.

    Exit status: 0 all equations hold for the counted boards; 1 an equation fails, or no change
    helps; 2 a bad config.

    \b
    Examples:
      rack check fig3
      rack check nasrem --verbose
      rack check fig3 --fix > fits.toml
      rack check brown brown/servo
      rack check nasrem --from runs/nasrem-20250101-120000
    """
    if others:
        if run is not None or fix or verbose or faults is not None:
            raise Failure("--from, --fix, --verbose and --faults take one config", 2)
        _check_joined([load(name, settings) for name in (config, *others)], as_json)
        return
    rack_config = load(config, settings, faults)
    if run is not None:
        rack_config = _use_measured_budgets(rack_config, run, percentile)
    judged = JudgedConfig.judge(rack_config)
    if judged.failures and sys.stderr.isatty():
        print("the timing does not fit; looking for changes that help", file=sys.stderr)
    fitting = find_repair(judged)
    if fix:
        _print_repaired_config(fitting, as_json)
        if fitting.end.failures:
            sys.exit(1)
        return
    core_warnings = list_replaced_cores(rack_config)
    inventory_document = build_inventory(rack_config, judged.layout, core_warnings)
    forecast = Forecast.from_rack(
        judged.timing, not core_warnings, _list_uncounted(config, rack_config)
    )
    arm = _compute_abilities(rack_config)
    # Load each proposal as the user would, because a change was found on the loaded config.
    fixes = [
        fix
        for fix in fitting.list_fixes()
        if not JudgedConfig.judge(
            load(config, [*settings, *fix.settings], faults), judged.budgets
        ).failures
    ][:MAX_FIXES]
    if as_json:
        fits = (None if forecast.uncounted else True) if forecast.holds else False
        repair = {**fitting.to_document(), "fixes": [fix.settings for fix in fixes]}
        verdict = {"fits": fits, "uncounted": forecast.uncounted, "repair": repair}
        timing = forecast.to_document() | verdict
        arm_document = None if arm is None else asdict(arm)
        print_json(inventory_document | {"arm": arm_document, "timing": timing})
    else:
        arguments_text = shlex.join([config, *(f"--set={setting}" for setting in settings)])
        measured = choose_run_folder(None, rack_config.name)
        measuring = (
            f"rack run {arguments_text} --seconds 10 --out {measured}",
            f"rack check {arguments_text} --from {measured}",
        )
        head, *rest = format_inventory(inventory_document)
        lines: list[str | TextTable] = [
            *format_verdict(forecast, () if run else measuring),
            head,
            *core_warnings,
            *format_summary(forecast, arm, rack_config.joints),
            *format_fixes(fixes, fitting.end.failures),
            *forecast.notes,
        ]
        if verbose:
            lines += [
                *rest[len(core_warnings) :],
                *format_arm_lines(inventory_document),
                *format_forecast(forecast),
            ]
        else:
            lines.append("--verbose shows every task, mailbox and equation")
        print_blocks(lines)
    if not forecast.holds:
        sys.exit(1)


def _list_uncounted(name: str, config: RackConfig) -> dict[str, str]:
    """Return a dictionary from what a check of one config cannot count to the reason."""
    uncounted = dict.fromkeys(config.host, "a host board has no rate")
    table = config.adapter.lan
    if table is not None and table.imports:
        partners = [name_config(path) for path in (*table.launch, *table.partners)]
        command = shlex.join(["rack", "check", name, *(partners or ["OTHER"])])
        uncounted["the response across racks"] = command
    return uncounted


def _check_joined(configs: list[RackConfig], as_json: bool) -> None:
    """Check several racks, and print the verdict on each and on the response across them."""
    # Import late, because most checks concern one rack.
    from rack.boards.config.joined import join_racks
    from rack.tools.timing.joined_check import format_joined_verdicts, judge_joined_racks

    verdicts = judge_joined_racks(join_racks(configs))
    forecasts = {
        config.name: Forecast.from_rack(
            JudgedConfig.judge(config).timing,
            not list_replaced_cores(config),
            dict.fromkeys(config.host, "a host board has no rate"),
        )
        for config in configs
    }
    if as_json:
        racks = {name: forecast.to_document() for name, forecast in forecasts.items()}
        print_json({"racks": racks, "across": [verdict.to_document() for verdict in verdicts]})
    else:
        lines = [
            f"{name}: {next(iter(format_verdict(forecast, ())))}"
            for name, forecast in forecasts.items()
        ]
        print_blocks([*format_joined_verdicts(verdicts), *lines])
    holds = [one.holds for one in verdicts] + [one.holds for one in forecasts.values()]
    if not all(holds):
        sys.exit(1)


def _use_measured_budgets(config: RackConfig, run: Path, percentile: float) -> RackConfig:
    """Replace the budgets of a config by those measured in a run.

    Raises `Failure` for a run of another rack.
    """
    # Import these only for --from, because they take long to load.
    from rack.tools.recording.cycles import measure_budgets
    from rack.tools.recording.recording import Recording

    recording = Recording(run)
    run_boards = sorted({task.board for task in recording.layout.tasks})
    config_boards = sorted(config.board)
    if run_boards != config_boards:
        raise Failure(
            f"{run}: its boards are {', '.join(run_boards)}, but those of '{config.name}' are"
            f" {', '.join(config_boards)}",
            2,
        )
    run_timing = build_rack_timing(recording.rack_config, recording.layout)
    return replace_budgets(
        config, subtract_interrupts(run_timing, measure_budgets(recording, percentile))
    )


def _compute_abilities(config: RackConfig) -> Abilities | None:
    """Compute reach and static payload of an arm. None for a rack with a hand or without an arm."""
    robot = config.robot
    if robot is None or robot.hand is not None:
        return None
    # Import late: MuJoCo takes 0.5 s to import, and only racks with an arm need it.
    from rack.levels.robot.abilities import compute_abilities

    return compute_abilities(build_rack_cell(config))


def _print_repaired_config(fitting: Repair, as_json: bool) -> None:
    """Print the repaired config on stdout and its changes on stderr, or both as JSON."""
    failures = fitting.end.failures
    config = None if failures else fitting.end.config.to_toml_text()
    if as_json:
        print_json(fitting.to_document() | {"config": config})
        return
    lines = [changes[0].text for changes in fitting.steps] + [*format_fixes((), failures)]
    print(*(lines or ["nothing to change"]), sep="\n", file=sys.stderr)
    if config is not None:
        print(config, end="")
