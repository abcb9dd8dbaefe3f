"""`rack campaign`: inject random faults of all kinds, and judge detection and recovery."""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from rack.tools.console.answer import Failure, print_json, write_json
from rack.tools.console.parameters import ConfigName, Json, Settings, option
from rack.tools.console.pictures import NO_PICTURES, can_draw

if TYPE_CHECKING:
    from rack.tools.faults.campaigns.campaign import Campaign
    from rack.tools.faults.campaigns.results import Results

INJECTIONS = 3
SIZES = 10
FAULTLESS_S = 60.0
NO_TIME = "no time for the report: 'rack campaign' with --out {} continues from here"
MAX_COUNT = 100_000
"""Upper bound for the number of injections of a kind, of kills and of sizes in a campaign."""


def campaign(
    config: ConfigName,
    injections: int = option(
        "--injections N",
        "minimum number of injections of each kind",
        INJECTIONS,
        min=0,
        max=MAX_COUNT,
    ),
    seed: int = option("--seed S", "seed; the same seed draws the same plans", 0, min=0),
    kinds: str | None = option(
        "--kinds A,B", "only these kinds; default: all kinds that apply to the rack"
    ),
    kills: int | None = option(
        "--kills N", "instead: only N kills from outside", min=1, max=MAX_COUNT
    ),
    standby: str | None = option(
        "--standby BOARD",
        "instead: faults of this board only, without a standby and with one, side by side",
    ),
    lockstep: bool = option("--lockstep", "trials in lockstep only; default: both", False),
    realtime: bool = option("--realtime", "trials in real time only; default: both", False),
    faultless: float | None = option(
        "--faultless S",
        f"seconds without faults, once alone and once under load; default {FAULTLESS_S:g}",
        min=0.0,
        max=1e6,
    ),
    load: bool = option(
        "--load", "run without faults only under load, made by stress-ng if installed", False
    ),
    sizes: int | None = option(
        "--sizes N",
        f"points on each curve of size against delay; default {SIZES}",
        min=0,
        max=MAX_COUNT,
    ),
    seconds: float | None = option(
        "--seconds S", "simulated seconds of a run, for a rack without a task", min=1.0, max=1e9
    ),
    settings: Settings = [],  # noqa: B006  typer copies it
    whole: bool = option(
        "--whole",
        "run each trial from its beginning; default: from a snapshot before its first fault",
        False,
    ),
    out: Path | None = option(
        "--out DIR", "folder, also to continue a campaign in; default: runs/campaign-<time>"
    ),
    as_json: Json = False,
) -> None:
    """Inject random faults of all kinds into runs of a rack, and judge each of them.

    Each trial has as many faults as fit into a run. Lockstep trials run in parallel on all cores,
    real-time trials one after the other. Up to its first fault a trial equals the faultless run. In
    lockstep it therefore continues from a snapshot of that run, each fault begins once the one
    before is settled, and the trial ends as soon as all verdicts are certain. --json lists the
    trials for which this was not possible, with reasons. --whole runs each trial from its beginning
    to the end of its task, with faults at their planned ticks. The campaign also includes runs
    without faults in real time, alone and under load. To continue an interrupted campaign, give the
    same --out.

    --standby BOARD injects faults into one board, first without a standby and then with one, and
    compares its output. A config that gives the board no standby gets one for the second half.

    Exit status: 0 the campaign passed; 1 a fault had no effect, or was not detected, handled and
    recovered from in time; a limit was violated; a process or segment was left behind; a task was
    neither done nor safely stopped; or a detection had no fault; 2 usage or config error.

    \b
    Examples:
      rack campaign nasrem
      rack campaign nasrem --kinds kill,mute --injections 20 --lockstep
      rack campaign nasrem --kills 100 --out runs/kills
      rack campaign nasrem --standby servo --kinds kill --injections 500 --lockstep
    """
    from rack.boards.config import load as load_config
    from rack.tools.console.interrupt import INTERRUPT
    from rack.tools.console.progress import open_progress
    from rack.tools.faults.campaigns.campaign import ORDER, Order, run_campaign
    from rack.tools.faults.campaigns.comparison import (
        WITHOUT,
        build_comparison,
        compare_campaigns,
        list_standby_settings,
    )
    from rack.tools.launch.folder import choose_run_folder

    if lockstep and realtime:
        raise Failure(
            "--lockstep and --realtime exclude each other; give one, or neither for both", 2
        )
    for name, value in {"kinds": kinds, "standby": standby}.items():
        if kills is not None and value is not None:
            why = "kills from outside are not a kind of fault and strike all boards; give one"
            raise Failure(f"--kills {kills} and --{name} {value} exclude each other: {why}", 2)
    rack_config = load_config(config, settings)
    if standby is not None:
        rack_config = load_config(config, [*settings, *list_standby_settings(rack_config, standby)])
    if seconds is None and not any(board.ends_run for board in rack_config.board.values()):
        raise Failure(f"{config}: no board ends the run; give its simulated time with --seconds", 2)
    is_special = kills is not None or standby is not None
    if faultless is None:
        # Skip faultless runs in real time if the user wants only lockstep, or only some faults.
        faultless = 0.0 if lockstep or is_special else FAULTLESS_S
    if sizes is None:
        sizes = 0 if is_special or realtime else SIZES
    modes = (lockstep,) if lockstep or realtime else (True, False)
    loads = (True,) if load else (False, True)
    order = Order(
        name=config,
        config=rack_config,
        injections=0 if kills else injections,
        seed=seed,
        modes=modes,
        kinds=kinds,
        kills=kills or 0,
        sizes=sizes,
        faultless_s=faultless,
        loads=loads,
        seconds=seconds,
        board=standby or "",
    )
    # An existing campaign is continued in its folder.
    part = "" if standby is None else WITHOUT
    is_begun = out is not None and (out / part / ORDER).is_file()
    folder = out if out is not None and is_begun else choose_run_folder(out, "campaign")
    with INTERRUPT.stop_orderly(unfinished=NO_TIME.format(folder)):
        with open_progress(silent=as_json) as progress:
            started = time.monotonic()
            run = run_campaign if standby is None else compare_campaigns
            pairs = run(order, folder, progress, whole)
        wall_s = time.monotonic() - started
        reports = [_write_report(work, results, wall_s) for work, results in pairs]
        report, text = reports[0]
        if standby is not None:
            report, text = build_comparison([results for _, results in pairs], reports)
            write_json(folder / "comparison.json", report)
            (folder / "comparison.md").write_text(text)
    picture_note = "" if can_draw() else f"; {NO_PICTURES}"
    print_json(report) if as_json else print(f"{text}\n{folder}/{picture_note}")
    if report["shortfalls"] or report["interrupted"]:
        sys.exit(1)


def _write_report(work: Campaign, results: Results, wall_s: float) -> tuple[dict[str, object], str]:
    """Write campaign.json, campaign.md and campaign.png.

    The picture is omitted without matplotlib, or if the campaign was interrupted.

    Returns:
        The document of campaign.json, and the text of campaign.md.
    """
    from rack.tools.faults.campaigns.report import CampaignReport

    work.folder.mkdir(parents=True, exist_ok=True)
    report = CampaignReport(work, results, wall_s)
    document = report.to_document()
    text = report.to_markdown()
    write_json(work.folder / "campaign.json", document)
    (work.folder / "campaign.md").write_text(text)
    # An interrupted command has too little time left to draw.
    if not results.is_interrupted and can_draw():
        from rack.tools.faults.campaigns.plot import plot_campaign

        plot_campaign(report, work.folder / "campaign.png")
    return document, text
