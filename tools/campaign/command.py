"""`rack campaign`: faults of all kinds at random, detected, reacted to, recovered from; figures of all of it."""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tools.answer import ConfigName, Failure, Json, Settings, print_json

if TYPE_CHECKING:
    from tools.campaign.campaign import Campaign, Order
    from tools.campaign.results import Results

SIZES = 10
FAULTLESS_S = 60.0

Runs = Annotated[
    int, typer.Option("--runs", metavar="N", min=1, help="trials, each with 3 to 5 faults in the whole task")
]
Seed = Annotated[int, typer.Option("--seed", metavar="S", min=0, help="the same seed draws the same plans")]
Kinds = Annotated[str | None, typer.Option(metavar="A,B", help="these kinds alone; default: all that it can have")]
Kills = Annotated[
    int | None, typer.Option(metavar="N", min=1, help="nothing but N kills from outside, in as many runs as it takes")
]
LockstepOnly = Annotated[bool, typer.Option("--lockstep", help="trials in lockstep alone; default: both by turns")]
RealtimeOnly = Annotated[bool, typer.Option("--realtime", help="trials in real time alone")]
Faultless = Annotated[
    float | None,
    typer.Option(
        metavar="S", min=0.0, help=f"faultless seconds in real time, alone and loaded, each; default {FAULTLESS_S:g}"
    ),
]
Sizes = Annotated[
    int | None, typer.Option(metavar="N", min=0, help=f"sizes for the curves of bias and noise; default {SIZES}")
]
Seconds = Annotated[
    float | None, typer.Option(metavar="S", min=1.0, help="simulated time of a run, for a rack that no task ends")
]
Out = Annotated[Path | None, typer.Option(metavar="DIR", help="folder of the campaign; default: runs/campaign-<time>")]


def campaign(
    config: ConfigName,
    runs: Runs = 20,
    seed: Seed = 0,
    kinds: Kinds = None,
    kills: Kills = None,
    lockstep: LockstepOnly = False,
    realtime: RealtimeOnly = False,
    faultless: Faultless = None,
    sizes: Sizes = None,
    seconds: Seconds = None,
    settings: Settings = [],  # noqa: B006  typer copies it
    out: Out = None,
    as_json: Json = False,
) -> None:
    """Inject faults of all kinds at random into runs of a rack, and publish what became of each.

    A trial in lockstep of the default rack takes about ten seconds, one in real time forty. The exit status is 1 where
    a fault was not found in its bound, a limit was violated, anything was left behind, a task was neither
    done nor safely stopped, or anything tripped without a fault.
    """
    from tools.campaign.campaign import Campaign
    from tools.campaign.interrupt import Interrupt
    from tools.folders import folder_of
    from tools.progress import progress_for

    order = _order(config, settings, runs, seed, kinds, kills, lockstep, realtime, faultless, sizes, seconds)
    folder, started = folder_of(out, "campaign"), time.monotonic()
    with Interrupt() as interrupt:
        with progress_for(silent=as_json) as progress:
            work = Campaign(order, folder, progress, interrupt)
            results = work.run()
        report, text = _written(work, results, time.monotonic() - started)
    print_json(report) if as_json else print(f"{text}\n{folder}/")
    sys.exit(1 if report["shortfalls"] or report["interrupted"] else 0)


def _order(
    name: str,
    settings: list[str],
    runs: int,
    seed: int,
    kinds: str | None,
    kills: int | None,
    lockstep: bool,
    realtime: bool,
    faultless: float | None,
    sizes: int | None,
    seconds: float | None,
) -> Order:
    """Return what is asked for. Raises `ConfigError`, and `Failure` for options that exclude each other."""
    from boards.config import load
    from tools.campaign.campaign import Order

    if lockstep and realtime:
        raise Failure("--lockstep and --realtime: each excludes the other; give one, or none for both by turns", 2)
    if kills is not None and kinds is not None:
        raise Failure(f"--kills {kills} and --kinds {kinds}: kills from outside are a kind by themselves; give one", 2)
    found = load(name, settings)
    if seconds is None and not any(board.ends_run for board in found.board.values()):
        raise Failure(f"{name}: no board ends the run: give --seconds, the simulated time of a run", 2)
    # What runs in real time beside the trials is left out where only lockstep, or only kills, were asked for.
    alone = lockstep or kills is not None
    return Order(
        name=name,
        config=found,
        runs=0 if kills else runs,
        seed=seed,
        modes=(True,) if lockstep else (False,) if realtime else (True, False),
        kinds=kinds,
        kills=kills or 0,
        sizes=(0 if kills or realtime else SIZES) if sizes is None else sizes,
        faultless_s=(0.0 if alone else FAULTLESS_S) if faultless is None else faultless,
        seconds=seconds,
    )


def _written(work: Campaign, results: Results, wall_s: float) -> tuple[dict[str, object], str]:
    """Write campaign.json, campaign.md and campaign.png; return the first two."""
    from tools.campaign.document import document
    from tools.campaign.markdown import markdown
    from tools.campaign.plot import plot

    work.folder.mkdir(parents=True, exist_ok=True)
    report = document(work, results, wall_s)
    text = markdown(report)
    (work.folder / "campaign.json").write_text(json.dumps(report, indent=2) + "\n")
    (work.folder / "campaign.md").write_text(text)
    plot(report, work.folder / "campaign.png")
    return report, text
