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
    r"""Is this machine fit for real time, and up to which rate?

    The fastest board of a rack runs at each rate in turn. The other levels keep their rates.
    Between these runs `cyclictest` of rt-tests sleeps to the same grid on the same core; no board
    can wake earlier than it. A rate is held if `cyclictest` is late by a cycle in at most 0.1 % of
    its wakes, and the board misses at most 0.1 % of its cycles in addition. Without SCHED_FIFO (see
    `ulimit -r`) no machine is fit.

    Lateness is the time from grid point to start. As root the rack also runs with idle cores held
    awake, and the last line recommends a value of `clock.idle_cores` for this machine. The bench
    takes about four minutes. Run nothing else during this time.

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

    Messages of 64 B to 16 kB are sent to one reader and to four, by every protocol, alternately
    with iceoryx2, HORUS and pipes of multiprocessing. The ratio is to the best of these peers.
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
    lockstep, alternately with another checkout. Without a checkout, the servo board in lockstep is
    compared with bare mj_step calls that replay the physics of its recorded run. TREE runs in its
    environment TREE/.venv.
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

    They run alternately with the lower bound: the same plans and cycles of the same levels in one
    process without a rack, whose messages must equal the rack's bit for bit. Ratios are to TREE if
    it is given, and to this bound otherwise. TREE runs in its environment TREE/.venv.
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

    A launch is the time from `rack run` to the first cycle of the fastest level; its ratio is to
    the checkout given by --against. The ratio of a short command is to a Python that only imports
    numpy. `rack report` shows a report that the run has made. Then the board that drives the arm of
    a running rack is killed repeatedly: the output shows the time to detection, and the time until
    the brakes of the arm are engaged.
    """
    from rack.tools.lab.benches.launch import measure_launches

    measure_and_show(
        lambda progress: measure_launches(config, rounds, kills, against, share, progress), as_json
    )
