"""`rack bench`: measure costs on this machine."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, complete_config_name, option
from rack.tools.lab.benches.harness import measure_and_show

Config = Annotated[
    str,
    typer.Option(
        "--config",
        metavar="CONFIG",
        help="config by name, or path to a .toml file",
        autocompletion=complete_config_name,
    ),
]
Against = Annotated[
    Path | None,
    typer.Option(
        metavar="TREE", help="another checkout of rack, measured alternately with this one"
    ),
]
Share = Annotated[
    bool,
    typer.Option(
        "--share",
        help="run even on cores of another rack's real-time boards, at the price of worse figures",
    ),
]
Rounds = Annotated[
    int, typer.Option(metavar="N", min=1, help="rounds; every contestant is measured once in each")
]

bench = typer.Typer(add_completion=False, no_args_is_help=True, rich_markup_mode=None)


@bench.callback()
def bench_group(context: typer.Context) -> None:
    """Measure costs on this machine."""
    # Raise an exception on a signal, so that temporary folders are removed.
    context.with_resource(INTERRUPT.raise_interrupted())


@bench.command()
def machine(
    config: Config = "nasrem",
    rate: list[float] | None = option(
        "--rate HZ", "rate; may be given several times", min=1, max=10_000
    ),
    seconds: float = option("--seconds S", "time of one run", 5.0, min=0.1),
    rounds: Rounds = 2,
    share: Share = False,
    as_json: Json = False,
) -> None:
    """Is this machine fit for real time, and up to which rate?

    The fastest board of a rack runs at each rate in turn. The other levels keep their rates. For
    comparison, `cyclictest` of rt-tests runs on the same core with the same period, because no
    board can wake up earlier. The machine is fit for a rate if `cyclictest` is late by a whole
    cycle in at most 0.1 % of its wake-ups, and the board misses at most 0.1 % more of its cycles.
    Without SCHED_FIFO (see `ulimit -r`) no machine is fit.

    Lateness is the time from a release to the start of its cycle. As root, the rack also runs with
    idle cores kept awake, and the last line recommends a value of `clock.idle_cores` for this
    machine. The bench takes about four minutes. Run nothing else during this time.

    Exit status: 0 fit at least at the lowest rate; 1 not fit, or a run failed; 2 a bad config.

    \b
    Examples:
      rack bench machine
      rack bench machine --rate 1000 --seconds 60 --rounds 1
    """
    from rack.tools.lab.benches.machine import RATES_HZ, measure_machine

    rates = rate or RATES_HZ
    verdict = measure_and_show(
        lambda progress: measure_machine(config, rates, seconds, rounds, share, progress), as_json
    )
    if not verdict.is_fit:
        raise typer.Exit(1)


@bench.command()
def mailbox(
    rounds: int = option("--rounds N", "turns of every contestant", 200, min=1),
    as_json: Json = False,
) -> None:
    """Measure the cost of a message, next to iceoryx2, HORUS and pipes.

    Messages of 64 B to 16 kB are sent to one and to four readers with every protocol, alternating
    with iceoryx2, HORUS and multiprocessing pipes. The ratio compares each protocol with the best
    of these three.
    """
    from rack.tools.lab.benches.mailbox import CASES, measure_mailboxes

    measure_and_show(lambda progress: measure_mailboxes(CASES, rounds, progress), as_json)


@bench.command()
def cycle(
    against: Against = None,
    seconds: float = option("--seconds S", "simulated seconds of one run", 6.0, min=2.0, max=1e9),
    rounds: Rounds = 3,
    share: Share = False,
    as_json: Json = False,
) -> None:
    """Measure the cost of a board's cycle, part by part.

    The bench runs boards that compute nothing, and each board of nasrem, in real time and in
    lockstep. With --against TREE, runs of this program alternate with runs of the checkout TREE in
    its environment TREE/.venv. Otherwise the servo board in lockstep is compared with bare mj_step
    calls that replay the physics of its recorded run.
    """
    from rack.tools.lab.benches.cycle import measure_cycles

    measure_and_show(
        lambda progress: measure_cycles(against, seconds, rounds, progress, share), as_json
    )


@bench.command()
def lockstep(
    against: Against = None,
    seconds: float | None = option(
        "--seconds S", "simulated seconds of one run, at most", min=1.0, max=1e9
    ),
    rounds: Rounds = 3,
    as_json: Json = False,
) -> None:
    """Measure the speed of nasrem, k1607 and fig4 in lockstep.

    The runs alternate with a lower bound: the same levels execute the same plans and cycles in one
    process without a rack. Ratios refer to the checkout TREE if --against names one, otherwise to
    this bound. TREE runs in its environment TREE/.venv.
    """
    from rack.tools.lab.benches.lockstep import RACKS, measure_lockstep

    racks = {
        name: min(filter(None, (default_s, seconds)), default=None)
        for name, default_s in RACKS.items()
    }
    measure_and_show(lambda progress: measure_lockstep(against, racks, rounds, progress), as_json)


@bench.command()
def launch(
    config: Config = "nasrem",
    rounds: Rounds = 10,
    kills: int = option("--kills N", "kills of the board", 10, min=1),
    against: Against = None,
    share: Share = False,
    as_json: Json = False,
) -> None:
    """Measure the duration of launches, commands and reactions.

    A launch lasts from `rack run` to the first cycle of the fastest level, and is compared with the
    checkout given by --against. Short commands are compared with a Python process that only imports
    numpy. `rack report` shows a report that already exists. Finally the board that drives the arm
    of a running rack is killed repeatedly, to measure the time to detection and the time until the
    brakes of the arm are engaged.
    """
    from rack.tools.lab.benches.launch import measure_launches

    measure_and_show(
        lambda progress: measure_launches(config, rounds, kills, against, share, progress), as_json
    )
