"""`rack run`: launch a rack, watch it, record it, report."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from rack.boards.config.files import assembled, named_classes
from rack.boards.crate.line import WarmCrate
from rack.boards.crate.requests import Preload
from rack.tools.console.answer import Document, Failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import (
    Anyway,
    Faults,
    Json,
    Settings,
    View,
    argument,
    config_names,
    option,
)

if TYPE_CHECKING:
    from rack.boards.config.schema import RackConfig
    from rack.boards.config.toml import Tables
    from rack.boards.crate.line import CrateLine
    from rack.tools.launch.launch import RunResult


def run(
    context: typer.Context,
    config: str | None = argument(
        "CONFIG", "config by name, or path to a .toml file", None, autocompletion=config_names
    ),
    lockstep: bool = option(
        "--lockstep",
        "start a tick only when every due task has finished: exact and repeatable",
        False,
    ),
    step: bool = option(
        "--step", "with --lockstep: hold before tick 0; 'rack step' lets the rack go on", False
    ),
    seconds: float | None = option(
        "--seconds S", "simulated seconds to run; default: until its end", min=0.0, max=1e9
    ),
    speed: float | None = option("--speed X", "run X times as fast as real time, as in 2 or 0.5"),
    settings: Settings = [],  # noqa: B006  typer copies it
    faults: Faults = None,
    entries: Path | None = option(
        "--entries RUN",
        "start no host boards and no other racks: what they sent in this recorded run"
        " enters again, at the same ticks; for host boards in real time, or with a prompt:"
        " other runs repeat in lockstep by themselves",
    ),
    origin: str | None = option(
        "--from RUN@TIME",
        "continue a run, in place of CONFIG, from TIME s, bit for bit; with --set or"
        " --faults a branch of it from there; the rack runs again in lockstep, from the"
        " beginning to TIME",
    ),
    anyway: Anyway = False,
    out: Path | None = option("--out DIR", "folder of the run; default: runs/<rack>-<time>"),
    no_record: bool = option(
        "--no-record", "leave no folder: no trace, no signals, no report", False
    ),
    view: View = False,
    share: bool = option(
        "--share",
        "run even on cores held by another rack's real-time boards: both will be late",
        False,
    ),
    as_json: Json = False,
) -> None:
    r"""Run a rack until its task ends, and report on the run.

    A rack that names others in adapter.lan.launch launches them, too, each in a process of its own;
    one that fails ends all. On a terminal a live table shows every task and what holds the rack;
    elsewhere one line a second is printed. --json prints the report as one document. With
    --no-record it has the same keys; those that need a recording are null.

    With --from, the rack first runs again, unchanged, from the beginning to TIME. What operators
    commanded in that run, before TIME and after it, is repeated; stops and faults by hand are not.
    Host boards and other racks
    are not started then: what they sent enters again at the same ticks.
    --seconds counts from the beginning of the run that is continued, as there.

    Exit status: 0 the task was done, with its objects at their goals, or --seconds have passed; no
    fault is latched, and the recording is complete. 1 otherwise, also if brakes or a level held the
    rack for over 5 s, or brakes for half of the run, without a cause in sight; if a level missed or
    skipped more of its cycles than supervision.max_missed_fraction permits; or if the system
    response exceeded its bound without a lost cycle. 2 usage or config error. A full disk ends the
    run. Ctrl-C ends it in order, with a report and exit status 130.

    \b
    Examples:
      rack run nasrem
      rack run nasrem --lockstep --seconds 5 --no-record --json | jq -r .digest
      rack run nasrem --faults bad-sensors --out runs/sensors
      rack run nasrem --set clock.speed=2 --view
      rack run nist-state-table --lockstep --step
      rack run ibm --lockstep --entries runs/ibm-20250101-120000
      rack run nasrem --lockstep --out runs/whole
      rack run --from runs/whole@10 --faults bad-sensors
    """
    if view and no_record:
        raise Failure(
            "--view and --no-record: the viewer shows what the recorder takes; leave one out", 2
        )
    if (config is None) == (origin is None):
        raise Failure("permitted: CONFIG, or --from RUN@TIME in its place; see --help", 2)
    overrides = list(settings)
    overrides += ["clock.mode=lockstep"] if lockstep or origin is not None else []
    overrides += [f"clock.speed={speed}"] if speed is not None else []
    if origin is not None and entries is not None:
        raise Failure("--entries and --from: a run that is continued has its own; leave one out", 2)
    if origin is not None:
        from rack.tools.launch.continued import beginning, run_of

        config = str(run_of(origin))
    assert config is not None
    read = assembled(config, overrides, faults)
    crate = _informed(context.obj, read.tables)
    from rack.boards.config.loader import validated
    from rack.tools.launch.folder import folder_of
    from rack.tools.launch.launch import NO_TIME, Beginning, run_rack
    from rack.tools.launch.verdict import headline
    from rack.tools.monitor.display import display_for

    if entries is not None:
        from rack.tools.recording.entries import recorded_entries

    found = validated(read)
    if step and found.clock.mode != "lockstep":
        raise Failure("--step: real time cannot be held between two ticks; add --lockstep", 2)
    folder = None if no_record else folder_of(out, found.name)
    begins = Beginning(crate=crate)
    with ExitStack() as stack:
        if origin is not None:
            warm = crate if isinstance(crate, WarmCrate) else None
            begins = stack.enter_context(beginning(found, origin, warm, anyway))
        # From the start of the run to the end of its report; during the launch a signal ends the
        # command at once.
        unfinished = NO_TIME.format(folder) if folder else ""
        stack.enter_context(INTERRUPT.orderly(unfinished=unfinished))
        with display_for(silent=as_json) as display:
            if entries is not None:
                begins = Beginning(crate=crate, entries=recorded_entries(found, entries))
            result = run_rack(
                found, seconds, folder, display, view=view, share=share, step=step, begins=begins
            )
        report = _report(found, folder, result, as_json)
    if not report["worked"]:
        # On stderr and last, where it is seen in any case.
        print(headline(found.name, report["outcome"], report["failures"]), file=sys.stderr)
    sys.exit(0 if report["worked"] else 1)


def _informed(crate: CrateLine | None, tables: Tables) -> CrateLine | None:
    """Let the crate load the levels that a config names, while this process imports what checks the
    config.
    """
    if crate is not None:
        own = tables.get("python_path")
        crate.send(
            Preload(
                named_classes(tables), (*sys.path, *map(str, own if isinstance(own, list) else []))
            )
        )
    return crate


def _report(config: RackConfig, folder: Path | None, result: RunResult, as_json: bool) -> Document:
    """Make the report, print it and return it. A run that has no report where one is wanted has
    failed.
    """
    from rack.tools.recording.folder_size import recorded_line
    from rack.tools.report.report import unrecorded, write_report
    from rack.tools.report.report_markdown import summary
    from rack.tools.report.stored import print_report

    data = unrecorded(config, asdict(result))
    text = "\n".join(summary(data))
    try:
        if folder is not None:
            data, text = write_report(folder)
    except (Failure, OSError, MemoryError) as error:
        why = f"{folder}: no report: {error or 'out of memory'}"
        data |= {"worked": False, "failures": [*data["failures"], why]}
        text = "\n".join(summary(data))
    if result.others:
        data["others"] = [asdict(other) for other in result.others]
    print_report(data, text, as_json)
    if as_json:
        return data
    if folder is not None:
        lasted_s = result.outcome.ticks * config.clock_ns * 1e-9
        print(recorded_line(folder, lasted_s))
    for other in result.others:
        ended = f"{other.rack}: {other.cause} after {other.ticks} ticks"
        print(f"{ended}, digest {other.digest}, {other.folder or 'not recorded'}")
    return data
