"""The bounds of all faults that can strike the shipped racks: nothing of them changes unseen."""

from __future__ import annotations

from collections.abc import Iterator

from rack.backplane.fault_table import Injection
from rack.backplane.layout import Layout
from rack.boards.config import load, resolve_layout
from rack.boards.faults.bounds import compute_last_read_ticks, list_affected_mailboxes
from rack.boards.faults.kind import KINDS, Kind
from tests.snapshots import ROOT, Snapshots, each_shipped_rack

SNAPSHOTS = Snapshots(__file__)
RESTARTS_S = (0.0, 0.25)


def injections(kind: Kind, layout: Layout) -> Iterator[Injection]:
    """Yield a fault of a kind for every task and for each mailbox that it writes."""
    parameters = tuple(float(p.default or 3.0) for p in kind.parameters)
    for task, process in enumerate(layout.processes):
        boxes = [at for at, box in enumerate(layout.mailboxes) if box.writer == process.name]
        for mailbox in (-1, *boxes):
            yield Injection(kind.number, task, mailbox, 0, 0, 0, 0, None, parameters)


@each_shipped_rack
def test_the_bounds_of_a_shipped_rack_are_as_before(name: str) -> None:
    layout = resolve_layout(load(ROOT / "configs" / name))
    parts: dict[str, object] = {}
    for kind in KINDS:
        if kind.where == "clock":
            parameters = (3.0,) * len(kind.parameters)
            clock = Injection(kind.number, -1, -1, 0, 0, 0, 0, None, parameters)
            parts[kind.name] = kind.compute_bound_ticks(clock, layout)
            continue
        found: list[object] = []
        for injection in injections(kind, layout):
            board = layout.processes[injection.task].name
            struck = list_affected_mailboxes(layout, injection.mailbox, board)
            readers = sorted({reader for box in struck for reader in box.readers})
            if kind.tasks and layout.find_task(board).role not in kind.tasks:
                continue
            if kind.takes_mailbox and not readers:
                continue
            for reader in (None, *readers):
                found.append(kind.compute_bound_ticks(injection, layout, reader))
            found += [kind.compute_recovery_ticks(board, layout, restart) for restart in RESTARTS_S]
        parts[kind.name] = found
    parts["last reads"] = [compute_last_read_ticks((box.name,), layout) for box in layout.mailboxes]
    SNAPSHOTS.check(name, {"bounds": parts})
