"""`rack bench`: what things cost on this machine."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer

from rack.tools.console.answer import Json, print_json
from rack.tools.console.interrupt import INTERRUPT

bench = typer.Typer(add_completion=False, no_args_is_help=True, rich_markup_mode=None)

Config = Annotated[str, typer.Option("--config", metavar="CONFIG", help="rack by name, or a path to a .toml file")]


@bench.callback()
def interruptible(context: typer.Context) -> None:
    """Measure what things cost on this machine."""
    context.with_resource(INTERRUPT.raising())  # temporary folders go, too


@bench.command()
def mailbox(as_json: Json = False) -> None:
    """A write and a read of 200 bytes, by protocol.

    Figures are medians; on a busy machine look at the best ones beside them.
    """
    from rack.tools.bench.mailbox import measure

    costs = measure()
    if as_json:
        print_json({"mailbox": [asdict(cost) for cost in costs]})
        return
    print(f"mailbox: {costs[0].bytes} bytes, field access to numpy views included; us a call, median (best)")
    for cost in costs:
        write = f"{cost.write_us:.2f} ({cost.write_best_us:.2f})"
        read = f"{cost.read_us:.2f} ({cost.read_best_us:.2f})"
        print(f"  {cost.protocol:14} write {write:14} read {read}")


@bench.command()
def recording(config: Config = "nasrem", as_json: Json = False) -> None:
    """Misses and lateness of a rack without a recorder, with it, and with a live viewer, interleaved."""
    from rack.tools.bench.recording import measure
    from rack.tools.console.tables import table, terminal_width

    costs = measure(config)
    if as_json:
        print_json({"recording": [asdict(cost) for cost in costs]})
        return
    head = ["phase", "cycles", "missed", "skipped", "late p50, ms", "p99", "p99.9", "max", "recorder, % of a core"]
    names = ("p50", "p99", "p99_9", "max")
    for line in table(
        head,
        [
            [
                *(cost.phase, str(cost.cycles), str(cost.missed), str(cost.skipped)),
                *(f"{cost.lateness_ms[name]:.3f}" if cost.lateness_ms else "-" for name in names),
                f"{cost.recorder_percent:.1f}",
            ]
            for cost in costs
        ],
        terminal_width(),
        ("cycles", "p99.9", "late p50, ms"),
    ):
        print(line)


@bench.command()
def switch(as_json: Json = False) -> None:
    """The context switch t_cs of eqs 3.8 and 3.9, beside the 100 us of the paper's 68020 boards.

    An executor of real-time priority wakes up on the core of a planner that computes, as on a board with both: the
    time from the planner's last instant to the executor's first, and back. Exit status 1 where the machine does not
    let a process have a real-time priority.
    """
    from rack.tools.bench.switch import measure

    cost = measure()
    print_json(asdict(cost)) if as_json else print(cost.text())


@bench.command()
def partition(
    config: Config = "nasrem",
    seconds: Annotated[float, typer.Option(min=1.0, max=1e9, help="simulated time of one run, s")] = 15.0,
    rounds: Annotated[int, typer.Option(min=1, help="runs of each partition, interleaved")] = 2,
    as_json: Json = False,
) -> None:
    """The same rack, partitioned otherwise: every planner tight or loose, on one core and on two.

    Runs them in real time, one after another, and prints what the paper argues about in words: misses, residuals,
    plan ages; and beside them what the timing model predicts of each from the budgets of the config.
    """
    from rack.tools.bench.partition import compare, lines_of
    from rack.tools.console.progress import progress_for
    from rack.tools.console.tables import print_wrapped, terminal_width

    with progress_for(as_json) as progress:
        found = compare(config, seconds, rounds, progress)
    if as_json:
        print_json({"config": config, "seconds": seconds, "rounds": rounds, "partitions": [asdict(p) for p in found]})
        return
    print_wrapped("\n".join(lines_of(found, terminal_width())))


@bench.command()
def response(
    config: Config = "nasrem",
    commands: Annotated[int, typer.Option(min=1, help="commands to measure, holds and resumes at every level")] = 200,
    seed: Annotated[int, typer.Option(help="seed of their ticks")] = 1,
    mode: Annotated[Literal["lockstep", "realtime"], typer.Option(help="how the racks run")] = "lockstep",
    twins: Annotated[int, typer.Option(min=0, help="holds whose run is compared with one without them; lockstep")] = 4,
    out: Annotated[Path | None, typer.Option(metavar="DIR", help="folder for response.png and .svg")] = None,
    as_json: Json = False,
) -> None:
    """The response to an operator: from the tick of a command to the torque that rests on it, beside the bounds R_s.

    Runs racks one after another, each with holds and resumes at random ticks, at every level in turn. In lockstep each
    must come at the predicted tick; and without it, in a twin of the run, the torque must differ from that tick on.
    Exit status 1 where one does not, or is beyond a bound.
    """
    from rack.tools.bench.response import Bench
    from rack.tools.console.progress import progress_for
    from rack.tools.console.tables import print_wrapped, terminal_width

    with progress_for(as_json) as progress:
        measured = Bench(config, mode, seed, progress).measure(commands, twins if mode == "lockstep" else 0)
    if as_json:
        print_json(measured.document())
    else:
        print_wrapped("\n".join(measured.lines(terminal_width())))
    if out is not None:
        from rack.tools.responding.plot import plot

        out.mkdir(parents=True, exist_ok=True)
        paths = plot(measured.response, out)
        if not as_json:
            print(f"pictures: {', '.join(map(str, paths))}")
    raise typer.Exit(0 if measured.held else 1)
