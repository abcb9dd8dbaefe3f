"""Rules for mailboxes: their writers and readers, their side of the rack, and their protocols."""

from __future__ import annotations

from rack.backplane.layout import TICK_PROTOCOLS
from rack.backplane.mailbox.queue import get_position_mailbox
from rack.backplane.message import State
from rack.boards.config.connections import TaskPorts, Wiring
from rack.boards.config.schema import LAN
from rack.boards.errors import Mistake, Mistakes
from rack.boards.exchange import EXCHANGE_PORT, build_exchange_message
from rack.boards.host.adapter import Adapter

PASS_IT = "pass it through a bus adapter: [board.<bridge>.params.pass]"
"""Advice for a reader on the other side of the rack."""


def check_ports(wiring: Wiring) -> Mistakes:
    """Check that the classes of tasks can be used and that their ports can be connected."""
    for place, why in wiring.unusable_classes.items():
        key = "program" if place.role == "host" else place.role
        yield Mistake(f"{place.table}.{key}", place.target, why)
    for place, ports in wiring.ports.items():
        table = place.table
        role = place.role
        inputs = ", ".join(ports.kind.inputs) or "none"
        for port, output in ports.outputs.items():
            if output.rests_on is not None and output.rests_on.name not in ports.inputs:
                why = f"its output '{port}' rests on '{output.rests_on.name}'; inputs: {inputs}"
                yield Mistake(f"{table}.{role}", place.target, why)
        for port, sources in wiring.config.get_rewired_ports(place).items():
            if port not in ports.kind.inputs:
                why = f"the {role} has no such port; ports: {inputs}"
                yield Mistake(f"{table}.{place.reads_key}.{port}", sources, why)
        yield from ports.mistakes


def check_writers(wiring: Wiring) -> Mistakes:
    """Check that no mailbox has two writers."""
    for ports in wiring.ports.values():
        for mailbox in ports.writes.values():
            first = wiring.writers[mailbox][0]
            if first is not ports:
                yield Mistake(f"mailbox {mailbox}", ports.task, f"{first.task} already writes it")


def check_read_mailboxes(wiring: Wiring) -> Mistakes:
    """Check that each input port reads an existing mailbox with the port's message type."""
    for ports in wiring.ports.values():
        for port, mailbox in ports.sources:
            place = _find_place(ports, port)
            needed = ports.inputs[port].message.message_type
            if not wiring.is_known(mailbox):
                yield Mistake(
                    place, mailbox, f"no task writes it; mailboxes: {', '.join(wiring.types)}"
                )
            elif (
                ports.is_whole
                and (carried := wiring.types.get(mailbox)) is not None
                and carried != needed
            ):
                why = (
                    f"carries {carried.name} {carried.version}; the port needs {needed.name}"
                    f" {needed.version}"
                )
                yield Mistake(place, mailbox, why)


def _find_place(ports: TaskPorts, port: str) -> str:
    """Return the place of an input in the config, as in "board.servo.reads.command"."""
    place = ports.place
    key = ports.kind.wired_by if issubclass(ports.kind, Adapter) else place.reads_key
    return f"{place.table}.{key}.{port}"


def check_ending_status(wiring: Wiring) -> Mistakes:
    """Check that a board with `ends_run` writes a status with a field `state`."""
    for name, board in wiring.config.board.items():
        status = wiring.types.get(f"{name}.status")
        why = ""
        if not wiring.is_known(f"{name}.status"):
            why = "its executor writes no status"
        elif status and not any(f.name == "state" and f.unit is State for f in status.fields):
            why = "its status has no field 'state' of State"
        if board.ends_run and why:
            yield Mistake(f"board.{name}.ends_run", True, why)


def check_sides(wiring: Wiring) -> Mistakes:
    """Check that boards and host boards read only mailboxes on their own side.

    Only a bus adapter may read mailboxes on both sides.
    """
    for task in wiring.ports.values():
        for port, mailbox in task.sources:
            if mailbox.partition(".")[0] not in wiring.unknown_boards and (
                why := _explain_wrong_side(wiring, task, mailbox)
            ):
                yield Mistake(_find_place(task, port), mailbox, why)


def _explain_wrong_side(wiring: Wiring, task: TaskPorts, mailbox: str) -> str:
    """Return the reason why a task or host board must not read a mailbox. Empty if it may."""
    is_host = task.place.role == "host"
    is_of_host = mailbox in wiring.host_side_mailboxes
    if task.joins_sides:
        return "it is already on the host side" if mailbox in wiring.mailboxes_to_host else ""
    if is_host == is_of_host:
        return ""
    if (source := wiring.passed_mailboxes.get(mailbox)) is None:
        side = "host" if is_of_host else "real-time"
        return f"it is on the {side} side; {PASS_IT}"
    writer = source.partition(".")[0]
    side = "host" if is_host else "real-time"
    return (
        f"a bus adapter joins the two sides; '{writer}' and '{task.place.board}' are both on the"
        f" {side} side"
    )


WHY_NOT_FOR_OPERATORS = {
    "lock": "the clock writes it and must not wait",
    "queue": "it already keeps every command",
    "interrupt": "the clock writes it, not a board",
}
"""Protocols that an operator's mailbox cannot have, with the reasons."""


def check_strict(wiring: Wiring) -> Mistakes:
    """If `protocol.strict` is set, report all settings that make a run depend on timing."""
    config = wiring.config
    if not config.protocol.strict:
        return
    why = "makes a run depend on timing, which protocol.strict = true refuses; must be"
    if config.protocol.default not in TICK_PROTOCOLS:
        yield Mistake("protocol.default", config.protocol.default, f"{why} time-slice or interrupt")
    for mailbox, protocol in config.protocol.mailbox.items():
        if protocol not in TICK_PROTOCOLS:
            yield Mistake(
                f"protocol.mailbox.{mailbox}", protocol, f"{why} one of {', '.join(TICK_PROTOCOLS)}"
            )
    for name in config.host:
        yield Mistake(f"host.{name}", None, f"a board without real time {why} a board with a rate")
    for name, board in config.board.items():
        for port, entry in board.exchange.items():
            if entry.asynchronous:
                yield Mistake(f"board.{name}.exchange.{port}.asynchronous", True, f"{why} false")


def check_exchange(wiring: Wiring) -> Mistakes:
    """Check that `exchange` tables name existing ports and have valid cycles and phases.

    Also check that no output of the executor has the name of the exchange record.
    """
    for ports in wiring.tasks:
        if not ports.exchange or not ports.is_whole:
            continue
        for port, entry in ports.exchange.items():
            place = f"board.{ports.task}.exchange.{port}"
            if port not in ports.inputs:
                why = f"no such port of the executor; ports: {', '.join(ports.inputs) or 'none'}"
                yield Mistake(place, None, why)
            if entry.asynchronous and entry.every > 1:
                why = "an asynchronous port is read in every cycle; must be 1"
                yield Mistake(f"{place}.every", entry.every, why)
            elif entry.phase >= entry.every:
                why = f"must be less than every: 0 to {entry.every - 1} cycles"
                yield Mistake(f"{place}.phase", entry.phase, why)
        record_type = build_exchange_message(ports.reads).message_type
        if ports.outputs[EXCHANGE_PORT].message.message_type != record_type:
            why = "the executor itself writes a mailbox of this name; rename its output"
            yield Mistake(f"board.{ports.task}.exchange", None, why)


def check_operator_mailboxes(wiring: Wiring) -> Mistakes:
    """Check that only the clock writes operator mailboxes, and that their protocol is valid."""
    for mailbox in wiring.operator_mailboxes:
        if mailbox in wiring.writers:
            why = "only the clock writes an operator's mailbox"
            yield Mistake(f"mailbox {mailbox}", wiring.writers[mailbox][0].task, why)
        protocol = wiring.config.protocol.mailbox.get(mailbox)
        if reason := WHY_NOT_FOR_OPERATORS.get(protocol or ""):
            why = f"{reason}; must be time-slice or double-buffer"
            yield Mistake(f"protocol.mailbox.{mailbox}", protocol, why)


def check_protocol_tables(wiring: Wiring) -> Mistakes:
    """Check that every mailbox in the tables of `[protocol]` exists."""
    table = wiring.config.protocol
    for key in ("mailbox", "depth"):
        for mailbox, value in getattr(table, key).items():
            if not wiring.is_known(mailbox):
                why = f"no such mailbox; mailboxes: {', '.join(wiring.types)}"
                yield Mistake(f"protocol.{key}.{mailbox}", value, why)


def check_queues(wiring: Wiring) -> Mistakes:
    """Check that queues have protocol queue and one reader, and that only queues have a depth."""
    # If a task reads from the wrong side, only `check_sides` reports it.
    if any(check_sides(wiring)):
        return
    table = wiring.config.protocol
    for mailbox, (ports, output) in wiring.writers.items():
        protocol = table.mailbox.get(mailbox, "queue")
        if output.queued and protocol != "queue":
            why = f"'{ports.task}' sends any number of messages in a cycle; must be queue"
            yield Mistake(f"protocol.mailbox.{mailbox}", protocol, why)
        elif wiring.find_protocol(mailbox) == "queue":
            yield from _check_queue(wiring, mailbox)
    for mailbox, depth in table.depth.items():
        if wiring.is_known(mailbox) and wiring.find_protocol(mailbox) != "queue":
            queues = [name for name in wiring.writers if wiring.find_protocol(name) == "queue"]
            why = f"it is not a queue and holds one message; queues: {', '.join(queues) or 'none'}"
            yield Mistake(f"protocol.depth.{mailbox}", depth, why)


def _check_queue(wiring: Wiring, mailbox: str) -> Mistakes:
    """Check that one port in this rack reads a queue and that its position mailbox is unique."""
    if get_position_mailbox(mailbox) in wiring.writers:
        why = (
            f"the reader of the queue '{mailbox}' writes its position under this name; rename the"
            " port"
        )
        yield Mistake(f"mailbox {get_position_mailbox(mailbox)}", None, why)
    reading = [
        (task.task, port)
        for task, port in wiring.reading_ports.get(mailbox, ())
        if task.place.role != "host"
    ]
    readers = [f"{task} ({port})" for task, port in reading]
    exports = [port for task, port in reading if task == LAN]
    if wiring.config.adapter.lan is not None and exports:
        why = (
            "a queue gives each message once, to its reader in this rack; export mailboxes that"
            " hold one message"
        )
        yield Mistake(f"adapter.lan.export.{exports[0]}.from", mailbox, why)
    elif len(readers) > 1:
        why = (
            f"a queue gives each message once, so it has one reader, not {len(readers)}:"
            f" {', '.join(readers)}"
        )
        yield Mistake(f"mailbox {mailbox}", None, why)
    elif not readers and not wiring.unknown_boards:
        why = "no task reads this queue, so it would stay full; it needs one reader"
        yield Mistake(f"mailbox {mailbox}", None, why)


def check_asynchronous(wiring: Wiring) -> Mistakes:
    """Check that no asynchronous port reads a mailbox with protocol queue or interrupt."""
    for ports in wiring.tasks:
        for port, mailbox in ports.sources:
            protocol = wiring.find_protocol(mailbox)
            if (
                port in ports.exchange
                and ports.exchange[port].asynchronous
                and protocol in ("queue", "interrupt")
            ):
                why = f"'{mailbox}' has protocol {protocol}; must be false"
                yield Mistake(f"board.{ports.task}.exchange.{port}.asynchronous", True, why)


def check_interrupts(wiring: Wiring) -> Mistakes:
    """Check that protocol interrupt is not used on the host side or by the network adapter."""
    for mailbox, protocol in wiring.config.protocol.mailbox.items():
        if protocol != "interrupt":
            continue
        place = f"protocol.mailbox.{mailbox}"
        if mailbox in wiring.host_side_mailboxes:
            why = "it is on the host side, where nothing is interrupted; remove this entry"
            yield Mistake(place, protocol, why)
        elif wiring.belongs_to_network_adapter(mailbox):
            why = "the network adapter writes it; must be time-slice or double-buffer"
            yield Mistake(place, protocol, why)
