"""`rack bench`: what the backplane costs on this machine."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Literal

import typer

from tools.answer import Json, print_json


def bench(
    what: Annotated[Literal["mailbox"], typer.Argument(help="mailbox: a write and a read of 200 bytes, by protocol")],
    as_json: Json = False,
) -> None:
    """Measure the backplane. Figures are medians; on a busy machine look at the best ones beside them."""
    from tools.bench.mailbox import measure

    costs = measure()
    if as_json:
        print_json({what: [asdict(cost) for cost in costs]})
        return
    print(f"{what}: {costs[0].bytes} bytes, field access to numpy views included; us a call, median (best)")
    for cost in costs:
        write = f"{cost.write_us:.2f} ({cost.write_best_us:.2f})"
        read = f"{cost.read_us:.2f} ({cost.read_best_us:.2f})"
        print(f"  {cost.protocol:14} write {write:14} read {read}")
