"""`rack bench`: measure costs on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from rack.tools.console.answer import Failure
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, config_names
from rack.tools.lab.benches.harness import show

Config = Annotated[
    str,
    typer.Option(
        "--config",
        metavar="CONFIG",
        help="config by name, or path to a .toml file",
        autocompletion=config_names,
    ),
]

Plot = Annotated[
    Path | None,
    typer.Option(metavar="DIR", help="write the figures as PNG and SVG into this folder"),
]
Against = Annotated[
    Path | None,
    typer.Option(metavar="TREE", help="another checkout of rack, measured by turns with this one"),
]
Share = Annotated[
    bool,
    typer.Option(
        "--share", help="run even on cores held by another rack's real-time boards: figures suffer"
    ),
]
Rates = Annotated[
    list[float] | None,
    typer.Option(
        "--rate", metavar="HZ", min=1, max=10_000, help="rate; may be given several times"
    ),
]
Rounds = Annotated[
    int, typer.Option(metavar="N", min=1, help="rounds; every contestant is measured once in each")
]
RackRounds = Annotated[int, typer.Option(metavar="N", min=1, help="runs of each rack, by turns")]
Seconds = Annotated[float, typer.Option(metavar="S", min=0.1, help="time of one measurement")]

bench = typer.Typer(add_completion=False, no_args_is_help=True, rich_markup_mode=None)


@bench.callback()
def interruptible(context: typer.Context) -> None:
    """Measure costs on this machine."""
    context.with_resource(INTERRUPT.raising())  # so that temporary folders are removed, too


@bench.command()
def mailbox(
    rounds: Annotated[
        int, typer.Option(metavar="N", min=1, help="turns of every contestant")
    ] = 200,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """What does a message cost, next to pipes, iceoryx2, zenoh?

    Messages of 64 B to 16 kB, one reader and four, by every protocol, by turns with iceoryx2, pipes
    and queues of multiprocessing, and zenoh. The ratio is to the best of these peers. A raw copy is
    the least that can be done, and no peer.
    """
    from rack.tools.lab.benches.mailbox import CASES, measure

    show(lambda progress: measure(CASES, rounds, progress), plot, as_json)


@bench.command()
def cycle(
    against: Against = None,
    seconds: Annotated[
        float, typer.Option(metavar="S", min=2.0, max=1e9, help="simulated seconds of one run")
    ] = 6.0,
    rounds: RackRounds = 3,
    share: Share = False,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """What does a board's cycle cost, part by part?

    Boards that compute nothing, and each board of nasrem, in real time and in lockstep, by turns
    with another checkout. The servo board is also compared with bare mj_step calls: the physics of
    its recorded run, replayed alone. TREE runs in its own environment, TREE/.venv.
    """
    from rack.tools.lab.benches.cycle import measure

    show(lambda progress: measure(against, seconds, rounds, progress, share), plot, as_json)


@bench.command()
def lockstep(
    against: Against = None,
    seconds: Annotated[
        float | None,
        typer.Option(metavar="S", min=1.0, max=1e9, help="simulated seconds of one run, at most"),
    ] = None,
    rounds: RackRounds = 3,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """How fast do nasrem, k1607 and fig4 run in lockstep?

    Next to them, by turns, the bare limit: the same plans and cycles of the same levels in one
    process without a rack. Its messages must be those of the rack, bit for bit. TREE runs in its
    own environment, TREE/.venv.
    """
    from rack.tools.lab.benches.lockstep import RACKS, measure

    racks = {name: min(filter(None, (own, seconds)), default=None) for name, own in RACKS.items()}
    show(lambda progress: measure(against, racks, rounds, progress), plot, as_json)


@bench.command()
def switch(as_json: Json = False) -> None:
    """What does a context switch cost, t_cs of eqs 3.8 and 3.9?

    On the paper's 68020 boards it took 100 us. An executor of real-time priority wakes up on the
    core of a busy planner, as on a board with both. The times are those from the planner's last
    instant to the executor's first, and back. Exit status 1 if the machine does not permit
    real-time priorities.
    """
    from rack.tools.lab.benches.switch import measure

    show(lambda progress: measure(), None, as_json)


@bench.command()
def partition(
    config: Config = "nasrem",
    seconds: Annotated[
        float, typer.Option(metavar="S", min=1.0, max=1e9, help="simulated seconds of one run")
    ] = 15.0,
    rounds: Annotated[
        int, typer.Option(metavar="N", min=1, help="runs of each partition, interleaved")
    ] = 2,
    as_json: Json = False,
) -> None:
    """Which layout: planners tight or loose, on one core or two?

    Each of the four partitions runs in real time, by turns. The output shows misses, residuals and
    plan ages, and next to them the timing model's predictions from the budgets of the config.
    """
    from rack.tools.lab.benches.partition import measure

    show(lambda progress: measure(config, seconds, rounds, progress), None, as_json)


@bench.command()
def response(
    config: Config = "nasrem",
    commands: Annotated[
        int, typer.Option(metavar="N", min=1, help="holds and resumes to measure, in all")
    ] = 200,
    seed: Annotated[int, typer.Option(metavar="N", help="seed of their ticks")] = 1,
    mode: Annotated[
        Literal["lockstep", "realtime"], typer.Option(help="how the racks run")
    ] = "lockstep",
    twins: Annotated[
        int,
        typer.Option(
            metavar="N",
            min=0,
            help="in lockstep: holds whose run is compared with one without them",
        ),
    ] = 4,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="folder for response.png and response.svg")
    ] = None,
    as_json: Json = False,
) -> None:
    """How soon does an operator's command act on the torque?

    Racks run one after another, with holds and resumes at random ticks, at every level in turn; the
    response is compared with its bounds R_s. In lockstep each command must act at the predicted
    tick; in a twin of the run without that command, the torque must differ from that tick on. Exit
    status 1 if one does not, or a bound is exceeded.
    """
    from rack.tools.lab.benches.response import ResponseRuns

    twins = twins if mode == "lockstep" else 0
    found = show(
        lambda progress: ResponseRuns(config, mode, seed, progress).measure(commands, twins),
        out,
        as_json,
    )
    if not found.held:
        raise typer.Exit(1)


@bench.command()
def clock(
    rate: Rates = None,
    seconds: Seconds = 2.0,
    rounds: Rounds = 3,
    share: Share = False,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """How late does a board start its cycle on this machine?

    Lateness is the time from grid point to start. An empty board waits in each of the ways that a
    config permits. By turns with it, on the same core at the same rate and priority: `cyclictest`
    and a bare loop of clock_nanosleep in Python. Ratios are to `cyclictest`.
    A board that sleeps and `cyclictest` also run with idle cores held awake, as root; all others
    let them sleep. The last line says which `clock.idle_cores` suits this machine: with fewer
    wake-ups late by a period, beyond chance, or else with the better worst one. Let nothing else
    run meanwhile.
    """
    from rack.tools.lab.benches.clock import RATES_HZ, measure
    from rack.tools.lab.benches.observed import Runs

    show(
        lambda progress: measure(tuple(rate or RATES_HZ), Runs(seconds, rounds, share), progress),
        plot,
        as_json,
    )


@bench.command()
def rate(
    config: Config = "nasrem",
    rate: Rates = None,
    seconds: Annotated[float, typer.Option(metavar="S", min=0.1, help="time of one run")] = 15.0,
    rounds: Rounds = 2,
    share: Share = False,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """What servo rate does a rack hold on this machine?

    The board that cycles at every tick runs at each rate in turn; the other levels keep their
    rates. A rate is held if at most 0.1 % of its cycles are missed beyond those that `cyclictest`
    is late by a cycle, at that rate on that core in the same minutes.
    """
    from rack.tools.lab.benches.observed import Runs
    from rack.tools.lab.benches.rate import RATES_HZ, measure

    show(
        lambda progress: measure(config, rate or RATES_HZ, Runs(seconds, rounds, share), progress),
        plot,
        as_json,
    )


@bench.command()
def boards(
    count: Annotated[
        list[int] | None,
        typer.Option(metavar="N", min=1, help="boards; may be given several times"),
    ] = None,
    seconds: Annotated[
        float, typer.Option(metavar="S", min=0.1, help="simulated time of one run")
    ] = 3.0,
    rounds: Rounds = 3,
    share: Share = False,
    against: Against = None,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """What does each additional board cost?

    Empty boards pass a message down a chain at 400 Hz on all cores. The output shows processor time
    a tick, missed cycles next to those of `cyclictest`, and the cycles that a message takes: as
    many as there are boards. In lockstep it shows the time of a tick, with --against also that of
    another checkout. Exit status 1 if a message took another time.
    """
    from rack.tools.lab.benches.boards import COUNTS, measure
    from rack.tools.lab.benches.chain import LONGEST
    from rack.tools.lab.benches.observed import Runs

    counts = sorted(set(count or COUNTS))
    if counts[-1] > LONGEST:
        raise Failure(
            f"--count {counts[-1]}: a crate takes up to {LONGEST} boards and the clock", 2
        )
    runs = Runs(seconds, rounds, share)
    found = show(lambda progress: measure(counts, runs, against, progress), plot, as_json)
    if not found.exact:
        raise typer.Exit(1)


@bench.command()
def launch(
    config: Config = "nasrem",
    rounds: Rounds = 10,
    kills: Annotated[int, typer.Option(metavar="N", min=1, help="kills of each board")] = 10,
    against: Against = None,
    share: Share = False,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """How long do launches, commands and reactions take?

    A launch is the time from `rack run` to the first cycle of the fastest level; its ratio is to
    the checkout given by --against. The ratio of a short command is to a Python that imports numpy
    and ends. `rack report` shows a report that the run has made. Then boards of a running rack are
    killed: the output shows the time to detection, and the time until the brakes of the arm are
    engaged.
    """
    from rack.tools.lab.benches.launch import LaunchCounts, measure

    show(
        lambda progress: measure(config, LaunchCounts(rounds, kills), against, share, progress),
        plot,
        as_json,
    )


@bench.command()
def systems(
    configs: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="CONFIG",
            help="config by name, or path to a .toml file; several",
            autocompletion=config_names,
        ),
    ] = None,
    seconds: Annotated[
        float, typer.Option(metavar="S", min=1.0, max=1e6, help="time of the run in real time")
    ] = 6.0,
    share: Share = False,
    plot: Plot = None,
    as_json: Json = False,
) -> None:
    """What do racks promise, and what do their runs show?

    Without CONFIG these are nasrem and the bundled racks that model other systems: about four
    minutes on two quiet cores, 25 seconds a rack.

    Of each config: the levels of its longest chain, boards, processes, cores, rates, the longest
    cycle R_max, the response R_s by eqs 3.2 and 3.3 and on the clock's grid, and whether it fits.

    Of a run in real time: R_s down and up, measured by what each message rests on; the age of
    commands when the lowest level reads them, and of its statuses when they are read; the response
    to an operator's hold, from giving it to the end of the cycle that acts on it; missed cycles
    next to those of `cyclictest` at that rate on those cores; how long plans take; accesses to the
    bus, and processor time.

    Of a run in lockstep in which every process is killed once: the ticks until the Rack and a
    neighbour detect it.

    Of three runs in lockstep of the same motion, if the rack has a config for it (three-poses.toml
    next to it, or NAME-three-poses.toml): the tracking error, its time, and the time from an
    operator's hold of the highest level that takes one, and from an emergency stop, until the arm
    rests.

    Exit status: 0 all racks ran; 1 a run failed; 2 a bad config.

    \b
    Examples:
      rack bench systems
      rack bench systems nasrem rccl --seconds 10 --plot pictures
    """
    from rack.tools.lab.benches.observed import Runs
    from rack.tools.lab.benches.systems.bench import measure
    from rack.tools.lab.benches.systems.bench import systems as bundled

    found = show(
        lambda progress: measure(configs or bundled(), Runs(seconds, 1, share), progress),
        plot,
        as_json,
    )
    if not found.worked:
        raise typer.Exit(1)
