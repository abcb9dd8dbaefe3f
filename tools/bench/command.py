"""`rack bench`: what the backplane and its recorder cost on this machine."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Literal

import typer

from tools.answer import Json, print_json


def bench(
    what: Annotated[
        Literal["mailbox", "recording"],
        typer.Argument(
            help="mailbox: a write and a read of 200 bytes, by protocol; "
            "recording: misses and lateness of a rack without it, with it, and with a live viewer"
        ),
    ],
    config: Annotated[str, typer.Option(metavar="CONFIG", help="rack for 'recording', by name or path")] = "nasrem",
    as_json: Json = False,
) -> None:
    """Measure the backplane. Figures are medians; on a busy machine look at the best ones beside them."""
    if what == "recording":
        _recording(config, as_json)
    else:
        _mailbox(as_json)


def _recording(config: str, as_json: bool) -> None:
    from tools.bench.recording import measure
    from tools.text_table import table

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
    ):
        print(line)


def _mailbox(as_json: bool) -> None:
    from tools.bench.mailbox import measure

    costs = measure()
    if as_json:
        print_json({"mailbox": [asdict(cost) for cost in costs]})
        return
    print(f"mailbox: {costs[0].bytes} bytes, field access to numpy views included; us a call, median (best)")
    for cost in costs:
        write = f"{cost.write_us:.2f} ({cost.write_best_us:.2f})"
        read = f"{cost.read_us:.2f} ({cost.read_best_us:.2f})"
        print(f"  {cost.protocol:14} write {write:14} read {read}")
