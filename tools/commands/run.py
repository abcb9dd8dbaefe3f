"""`rack run`: launch a rack, watch it, record it, and report on it."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from rack.boards.config.files import assemble, list_level_classes
from rack.boards.crate.line import WarmCrate
from rack.boards.crate.requests import Preload
from rack.tools.console.answer import Document, Failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import (
    Anyway,
    Faults,
    Full,
    Json,
    Settings,
    View,
    argument,
    complete_config_name,
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
        "CONFIG",
        "config by name, or path to a .toml file",
        None,
        autocompletion=complete_config_name,
    ),
    lockstep: bool = option(
        "--lockstep",
        "start a tick only when every due task has finished: exact and repeatable",
        False,
    ),
    step: bool = option(
        "--step", "with --lockstep: hold before tick 0; 'rack step' continues the rack", False
    ),
    seconds: float | None = option(
        "--seconds S", "simulated seconds to run; default: until its end", min=0.0, max=1e9
    ),
    speed: float | None = option("--speed X", "run X times as fast as real time, as in 2 or 0.5"),
    settings: Settings = [],  # noqa: B006  typer copies it
    faults: Faults = None,
    entries: Path | None = option(
        "--entries RUN",
        "do not start host boards and other racks; instead replay what they sent in this recorded"
        " run, at the same ticks; needed to repeat runs with real-time host boards or a prompt,"
        " since all others repeat in lockstep by themselves",
    ),
    origin: str | None = option(
        "--from RUN@TIME",
        "in place of CONFIG: continue a run from TIME s, bit for bit, or branch off with --set or"
        " --faults; the rack first runs again in lockstep, from the beginning to TIME",
    ),
    anyway: Anyway = False,
    out: Path | None = option("--out DIR", "folder of the run; default: runs/<rack>-<time>"),
    no_record: bool = option(
        "--no-record", "leave no folder: no trace, no signals, no report", False
    ),
    view: View = False,
    ros2: bool = option("--ros2", "show the rack to nodes of ROS 2; see 'rack bridge'", False),
    foxglove: bool = option("--foxglove", "show the rack in Foxglove; see 'rack bridge'", False),
    share: bool = option(
        "--share",
        "run even on cores of another rack's real-time boards, although both will be late",
        False,
    ),
    full: Full = False,
    as_json: Json = False,
) -> None:
    """Run a rack until its task ends, and report on the run.

    A rack that names others in adapter.lan.launch also launches them, each by a separate 'rack
    run'. If one fails, all are stopped. On a terminal a live table shows every task and what holds
    the rack; elsewhere one line a second is printed on stderr. The end prints the summary that
    'rack report' explains, --full the whole report, --json the report as one document. With
    --no-record it has the same keys; those that need a recording are null.

    With --from, the rack first runs again, unchanged, from the beginning to TIME. Commands of
    operators in that run, before TIME and after it, are repeated. Emergency stops and faults given
    by hand are not. Host boards and other racks are not started. What they sent is replayed at the
    same ticks. --seconds counts from the beginning of the run that is continued.

    Exit status: 0 the task was done, with its objects at their goals, or --seconds have passed; no
    fault is latched, and the recording is complete. 1 otherwise, also if brakes or a level held the
    rack for over 5 s, or brakes for half of the run, without a known cause; if a level missed or
    skipped more of its cycles than supervision.max_missed_fraction permits; or if the system
    response exceeded its bound without a lost cycle. 2 usage or config error. A full disk ends the
    run. Ctrl-C ends it cleanly, with a report and exit status 130.

    \b
    Examples:
      rack run nasrem
      rack run nasrem --lockstep --seconds 5 --no-record --json | jq -r .digest
      rack run nasrem --faults bad-sensors --out runs/sensors
      rack run nasrem --set clock.speed=2 --view
      rack run nasrem --ros2 --foxglove
      rack run nist-state-table --lockstep --step
      rack run ibm --lockstep --entries runs/ibm-20250101-120000
      rack run nasrem --lockstep --out runs/whole
      rack run --from runs/whole@10 --faults bad-sensors
    """
    if view and no_record:
        raise Failure("--view and --no-record: the viewer shows what is recorded; leave one out", 2)
    if (config is None) == (origin is None):
        raise Failure("give either CONFIG or --from RUN@TIME; see --help", 2)
    if origin is not None:
        if entries is not None:
            raise Failure(
                "--entries and --from: --from replays the entries anyway; leave one out", 2
            )
        lockstep = True
        from rack.tools.launch.continued import find_run_config, open_beginning

        config = str(find_run_config(origin))
    assert config is not None
    overrides = [*settings, *["clock.mode=lockstep"] * lockstep]
    overrides += [f"clock.speed={speed}"] if speed is not None else []
    tables_read = assemble(config, overrides, faults)
    crate = _preload_levels(context.obj, tables_read.tables)
    from rack.boards.config.loader import validate
    from rack.tools.launch.folder import choose_run_folder
    from rack.tools.launch.launch import UNFINISHED_HINT, Beginning, run_rack
    from rack.tools.launch.verdict import format_headline
    from rack.tools.monitor.display import open_display
    from rack.tools.report.stored import print_report

    rack_config = validate(tables_read)
    if step and rack_config.clock.mode != "lockstep":
        raise Failure("--step: real time cannot be held between two ticks; add --lockstep", 2)
    folder = None if no_record else choose_run_folder(out, rack_config.name)
    begins = Beginning(crate=crate)
    with ExitStack() as stack:
        if origin is not None:
            warm = crate if isinstance(crate, WarmCrate) else None
            begins = stack.enter_context(open_beginning(rack_config, origin, warm, anyway))
        # From here to the end of the report, a signal ends the run in an orderly manner. Only
        # during the launch, `run_rack` lets a signal end the command at once.
        unfinished = UNFINISHED_HINT.format(folder) if folder else ""
        stack.enter_context(INTERRUPT.stop_orderly(unfinished=unfinished))
        with open_display(as_json, sys.stderr) as display:
            if entries is not None:
                from rack.tools.recording.entries import load_entries

                begins = Beginning(crate=crate, entries=load_entries(rack_config, entries))
            result = run_rack(
                rack_config,
                seconds,
                folder,
                display,
                view=view,
                share=share,
                step=step,
                bridges=["ros2"] * ros2 + ["foxglove"] * foxglove,
                beginning=begins,
            )
        report = _report_run(rack_config, folder, result)
        print_report(report, as_json, full)
    if not report["worked"] and not sys.stdout.isatty():
        # Print the verdict on stderr as well, where the user sees it in any case.
        print(
            format_headline(rack_config.name, report["outcome"], report["failures"]),
            file=sys.stderr,
        )
    sys.exit(0 if report["worked"] else 1)


def _preload_levels(crate: CrateLine | None, tables: Tables) -> CrateLine | None:
    """Ask the crate to import a config's levels while this process checks the config.

    Returns `crate`, which is None if no crate was started early.
    """
    if crate is not None:
        python_path = tables.get("python_path")
        crate.send_request(
            Preload(
                list_level_classes(tables),
                (*sys.path, *map(str, python_path if isinstance(python_path, list) else [])),
            )
        )
    return crate


def _report_run(config: RackConfig, folder: Path | None, result: RunResult) -> Document:
    """Write and return the report. The run counts as failed if it cannot be written."""
    from rack.tools.report.report import build_unrecorded_report, write_report

    data = build_unrecorded_report(config, asdict(result))
    try:
        if folder is not None:
            data, _ = write_report(folder)
    except (Failure, OSError, MemoryError) as error:
        why = f"{folder}: no report: {error or 'out of memory'}"
        data |= {"worked": False, "failures": [*data["failures"], why]}
    return data
