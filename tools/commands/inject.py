"""`rack inject`: inject a fault into a running rack."""

from __future__ import annotations

from collections.abc import Iterator

from rack.tools.console.answer import Document, Failure, print_answer
from rack.tools.console.parameters import (
    Json,
    Timeout,
    argument,
    check_rack_name,
    check_timeout,
    option,
)
from rack.tools.console.tables import format_fitted_table


def inject(
    rack: str | None = argument(
        "RACK", "running rack by name, as 'rack list' shows it", None, callback=check_rack_name
    ),
    board: str | None = argument(
        "BOARD", "task to disturb: servo, servo.planner, ..., or clock", None
    ),
    kind: str | None = argument("KIND", "kind of fault, as 'rack inject --list' shows it", None),
    parameters: list[str] | None = argument(
        "KEY=VALUE", "parameters of the kind, as in size=0.05", None
    ),
    lasts: str | None = option("--for TIME", "duration in simulated time, as in 0.5s or 20ms"),
    cycles: str | None = option("--cycles N", "duration in cycles of the task"),
    mailbox: str | None = option(
        "--mailbox NAME", "mailbox to disturb; default: all that the task writes"
    ),
    tick: str | None = option("--tick T", "tick at which the fault begins; default: the next one"),
    when: str | None = option(
        "--when CONDITION", 'begin when this holds, as in "task.status.action == 2"'
    ),
    phase: str | None = option(
        "--phase X", "fraction of its first tick that passes before it begins, 0 to below 1"
    ),
    seed: str | None = option("--seed N", "seed of its random choices"),
    wait: bool = option("--wait", "wait until the fault, or the run, is over", False),
    timeout: Timeout = None,
    withdraw: int | None = option(
        "--withdraw NO", "withdraw a fault that has not begun; --list shows its number"
    ),
    is_list: bool = option("--list", "list the kinds; with RACK, the faults of that rack", False),
    as_json: Json = False,
) -> None:
    """Inject a fault into a running rack.

    The fault begins at the next tick and lasts to the end of the run, unless --tick, --when, --for
    or --cycles say otherwise. With --tick or --when, or on a rack that is held, the command arms
    the fault and returns at once; with --wait it returns when the fault is over.

    Exit status: 0 the fault has begun, is armed, or with --wait is over; 1 it did not begin, or
    --timeout has passed; 2 usage.

    \b
    Examples:
      rack inject nasrem servo kill
      rack inject nasrem servo sensor-bias joint=2 size=0.05 --for 0.2s
      rack inject nasrem primitive mute --when "task.status.action == 2"
      rack inject nasrem servo drop --tick 4000 --cycles 40 --wait --timeout 60
      rack inject nasrem --list
      rack inject nasrem --withdraw 0
    """
    if is_list and rack is None:
        print_answer(build_kinds_document(), format_kinds(), as_json)
        return
    needs_fault = not is_list and withdraw is None
    if rack is None or (needs_fault and (board is None or kind is None)):
        raise Failure(
            "RACK, BOARD and KIND are needed, as in: rack inject nasrem servo kill; or --list", 2
        )
    check_timeout(timeout, wait)
    from rack.backplane.segment import Segment
    from rack.tools.faults.live import LiveRack

    live = LiveRack(Segment.attach(rack))
    if is_list:
        print_answer(live.list_faults(), live.format_table(), as_json)
        return
    if withdraw is not None:
        answer = live.withdraw_fault(withdraw)
    else:
        request: Document = {
            "board": board,
            "kind": kind,
            "for": lasts,
            "cycles": cycles,
            "mailbox": mailbox,
            "tick": tick,
            "when": when,
            "phase": phase,
            "seed": seed,
            **_parse_parameters(parameters or []),
        }
        answer = live.inject_fault(request, wait, timeout)
    print_answer(answer, answer["message"], as_json)


def _parse_parameters(parameters: list[str]) -> dict[str, str]:
    """Parse parameters given as KEY=VALUE. Raises `Failure`."""
    values = {}
    for text in parameters:
        key, _, value = text.partition("=")
        if not key or not value:
            raise Failure(f"'{text}': a parameter must be key=value, as in size=0.05", 2)
        values[key.strip()] = value.strip()
    return values


def format_kinds() -> Iterator[str]:
    """Yield the lines of a table of fault kinds, and of a table of their parameters."""
    from rack.boards.faults import KINDS

    remarks = {"real time only": "realtime", "strikes once": "once"}
    rows = [
        [
            kind.name,
            kind.means,
            str(kind.bound),
            ", ".join(text for text, key in remarks.items() if getattr(kind, key)),
        ]
        for kind in KINDS
    ]
    yield from format_fitted_table(["kind", "effect", "found within", ""], rows)
    yield ""
    yield "Cycles are those of the disturbed task. A cycle of a planner is its time slice."
    yield "A delivery is the time until a message is visible and its reader has read it."
    yield ""
    numbers = [
        [
            kind.name,
            p.name,
            p.unit,
            "none" if p.default is None else f"{p.default:g}",
            f"{p.least:g} to {p.most:g}",
            p.meaning,
        ]
        for kind in KINDS
        for p in kind.parameters
    ]
    yield from format_fitted_table(
        ["kind", "parameter", "unit", "default", "range", "meaning"], numbers
    )


def build_kinds_document() -> list[Document]:
    """Build the description of the fault kinds as plain data."""
    from rack.boards.faults import KINDS

    numbers = ("name", "unit", "meaning", "default", "least", "most", "is_whole")
    return [
        {
            **{key: getattr(kind, key) for key in ("name", "where", "means")},
            "seen_as": list(kind.codes),
            "bound": str(kind.bound),
            "parameters": [{key: getattr(p, key) for key in numbers} for p in kind.parameters],
            **{
                key: getattr(kind, key)
                for key in ("realtime", "once", "recoverable", "takes_mailbox")
            },
        }
        for kind in KINDS
    ]
