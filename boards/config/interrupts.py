"""Protocol interrupt in a config: which mailboxes may have it, when their messages are sent, and what they cost."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from rack.backplane.layout import InterruptSpec, MailboxSpec, TaskSpec, depth_for
from rack.boards.config.schema import LAN, RackConfig
from rack.boards.errors import Mistake

if TYPE_CHECKING:
    from rack.boards.config.layout import Wiring

WORD_BYTES = 4
"""Bytes of a word of `[protocol.interrupt]`: of the 68020's bus."""
NS_PER_US, NS_PER_MS = 1e3, 1e6


def is_exempt(wiring: Wiring, mailbox: str) -> bool:
    """Say whether a mailbox cannot have the protocol: no board of the rack sends its messages."""
    return mailbox in wiring.operated or _is_of_network(wiring, mailbox)


def _is_of_network(wiring: Wiring, mailbox: str) -> bool:
    return wiring.config.adapter.lan is not None and mailbox.partition(".")[0] == LAN


def interrupt_mistakes(wiring: Wiring) -> Iterator[Mistake]:
    """Yield a mistake for every mailbox of which the config demands the protocol, and that cannot have it."""
    for mailbox, given in wiring.config.protocol.mailbox.items():
        why = ""
        if given != "interrupt":
            continue
        if mailbox in wiring.sides.of_host:
            why = "it is on the host side, where nothing is interrupted; permitted: no entry"
        elif _is_of_network(wiring, mailbox):
            why = "the network adapter writes it as messages come in; permitted: time-slice, double-buffer"
        if why:
            yield Mistake(f"protocol.mailbox.{mailbox}", given, why)


def with_interrupts(config: RackConfig, box: MailboxSpec, tasks: Mapping[str, TaskSpec], kept: int) -> MailboxSpec:
    """Return a mailbox of protocol interrupt with what its messages cost, and when they are sent and visible.

    `kept`: ticks of which it keeps the messages. Between tasks of one slot, and into the network adapter, which reads
    shared memory, nothing is interrupted.
    """
    writer, clock_ns = tasks[box.writer], config.clock_ns
    readers = [tasks[reader] for reader in box.readers]
    spared = {writer.slot, *(task.slot for task in readers if task.role == "host" or _is_adapter(config, task))}
    table, words = config.protocol.interrupt, -(-box.size // WORD_BYTES)
    service_ns = round((table.fixed_us + table.word_us * words) * NS_PER_US)
    sent_ns = _sent_ns(config, writer)
    slots = tuple(sorted({task.slot for task in readers} - spared))
    delay = -(-(sent_ns + service_ns * bool(slots)) // clock_ns)
    interrupt = InterruptSpec(sent_ns, service_ns, table.depth, -(-sent_ns // clock_ns), box.delay, slots)
    # As late as it is served, a message is still in its slot.
    waits = -(-(table.depth + 1) * service_ns // clock_ns)
    slowest = max((task.every * task.within_cycles for task in readers), default=0)
    depth = depth_for(max(slowest + delay + waits, kept), box.every)
    return replace(box, delay=delay, depth=depth, interrupt=interrupt)


def _is_adapter(config: RackConfig, task: TaskSpec) -> bool:
    return config.adapter.lan is not None and task.board == LAN


def _sent_ns(config: RackConfig, writer: TaskSpec) -> int:
    """Return the time from a release until its messages are sent: its budget, or a tick; a plan's, its whole slice."""
    longest_ns = writer.every * writer.within_cycles * config.clock_ns
    if writer.role == "planner":
        return longest_ns
    budget = config.board[writer.board].budget
    parts = () if budget is None else (budget.exchange_ms, budget.read_ms, budget.process_ms, budget.write_ms)
    return min(round(sum(parts) * NS_PER_MS) or config.clock_ns, longest_ns)
