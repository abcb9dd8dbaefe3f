"""Queues of a rack: the rules for their wiring, and their size."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

from rack.backplane.layout import depth_for
from rack.backplane.mailbox.queue import taken_name
from rack.boards.config.schema import LAN
from rack.boards.errors import Mistake

if TYPE_CHECKING:
    from rack.boards.config.layout import Wiring

SUSTAINED = 4
"""Messages a cycle of the writer, on average, of which a recorder loses none however deep the queue is."""


def queue_mistakes(wiring: Wiring) -> Iterator[Mistake]:
    """Yield every mistake in the queues of a rack."""
    table = wiring.config.protocol
    for mailbox, (ports, output) in wiring.writers.items():
        given = table.mailbox.get(mailbox, "queue")
        if output.queued and given != "queue":
            why = f"'{ports.task}' sends any number of messages in a cycle; permitted: queue"
            yield Mistake(f"protocol.mailbox.{mailbox}", given, why)
        elif wiring.protocol(mailbox) == "queue":
            yield from _wired(wiring, mailbox)
    for mailbox, depth in table.depth.items():
        if not wiring.is_known(mailbox):
            yield Mistake(f"protocol.depth.{mailbox}", depth, f"no such mailbox; mailboxes: {wiring.names()}")
        elif wiring.protocol(mailbox) != "queue":
            queues = [name for name in wiring.writers if wiring.protocol(name) == "queue"]
            why = f"not a queue: it holds one message; queues: {', '.join(queues) or 'none'}"
            yield Mistake(f"protocol.depth.{mailbox}", depth, why)


def _wired(wiring: Wiring, mailbox: str) -> Iterator[Mistake]:
    """Check one queue: exactly one port reads it, and its reader's position has a name of its own."""
    if taken_name(mailbox) in wiring.writers:
        why = f"the reader of the queue '{mailbox}' writes its position under this name; rename the port"
        yield Mistake(f"mailbox {taken_name(mailbox)}", None, why)
    readers = [f"{task.task} ({port})" for task in wiring.tasks for port, box in task.sources if box == mailbox]
    exports = [port for task in wiring.tasks if task.task == LAN for port, box in task.sources if box == mailbox]
    if wiring.config.adapter.lan is not None and exports:
        why = "a queue gives each message once, to its one reader here; permitted: mailboxes that hold one message"
        yield Mistake(f"adapter.lan.export.{exports[0]}.from", mailbox, why)
    elif len(readers) > 1:
        why = f"a queue gives each message once, so it has one reader, not {len(readers)}: {', '.join(readers)}"
        yield Mistake(f"mailbox {mailbox}", None, why)
    elif not readers and not wiring.has_unknown:
        why = "no task reads this queue, so it would fill and stay full; permitted: one reader"
        yield Mistake(f"mailbox {mailbox}", None, why)


def queue_slots(capacity: int, every: int, cycle: int, kept: int) -> int:
    """Return the slots of a queue that keep the messages of the last `kept` ticks.

    In `cycle` ticks, from a release of the writer until it can know that the reader has taken the messages, no more
    than the capacity can be sent. A deep queue keeps fewer: `SUSTAINED` messages in each of the writer's cycles.
    """
    most = capacity * (1 + kept // cycle)
    return depth_for(min(most, 2 * capacity + SUSTAINED * kept // every), 1)
