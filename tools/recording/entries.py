"""What entered a recorded run from outside, so that it can be repeated: through its adapters, for a
replay without host boards and other racks, and from its operators.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import MailboxSpec
from rack.backplane.message import COMMAND_ID
from rack.backplane.operator_table import Request
from rack.boards.classes import find_class
from rack.boards.config.commands import requests
from rack.boards.config.resolved import resolve
from rack.boards.config.schema import RackConfig
from rack.boards.host.adapter import Adapter
from rack.boards.wiring import Entries, Rows
from rack.tools.console.answer import Failure
from rack.tools.recording.recording import Recording


def recorded_entries(config: RackConfig, run: Path, asked: str = "") -> dict[str, Entries]:
    """Return what each adapter of a config wrote in the run in folder `run`, by adapter and port.

    Raises `ConfigError` for mistakes in the config, and `Failure`, which begins with what was
    `asked`, if the run has other entries, or lost some.
    """
    asked = asked or f"--entries {run}"
    plan = resolve(config)
    layout = plan.layout
    recording = Recording(run)
    ran_with = recording.rack_config
    if ran_with.adapter.lan is not None and ran_with.clock.mode != "lockstep":
        raise Failure(f"{asked}: in real time, on a network: only a run in lockstep is repeated", 2)
    ran = {mailbox.name: mailbox for mailbox in recording.layout.mailboxes}
    found: dict[str, Entries] = {}
    for task in plan.tasks:
        kind = find_class(task.target, object)
        ports = kind.replayed(task.context.params, layout) if issubclass(kind, Adapter) else {}
        if not ports:
            continue
        boxes = {port: layout.mailbox(f"{task.task}.{port}") for port in ports}
        for box in boxes.values():
            needed = _type_of(box)
            there = _type_of(ran[box.name]) if box.name in ran else "no such mailbox"
            if there != needed:
                raise Failure(f"{asked}: {box.name}: {there}; needed: {needed}", 2)
            if recording.kept:
                raise Failure(f"{asked}: {recording.kept_text}", 2)
            _check_whole(box, recording, asked)
        found[task.task] = {port: _rows(recording, box, ports[port]) for port, box in boxes.items()}
    if not found:
        raise Failure(f"{asked}: '{config.name}' has no adapter", 2)
    return found


def recorded_commands(recording: Recording) -> tuple[Request, ...]:
    """Return what operators commanded in a recorded run besides its config's commands, at the same
    ticks, in their order.

    Raises `Failure` if the recording lacks some.
    """
    commanded = _issued(recording)
    if commanded and recording.kept:
        raise Failure(f"--from {recording.folder}: {recording.kept_text}", 2)
    for known in requests(recording.rack_config, recording.layout):
        # Issued at its tick, or later in real time: the same may have been commanded before it.
        later = (r for r in commanded if r.tick >= known.tick)
        given = (r for r in later if replace(r, tick=known.tick) == known)
        if (one := next(given, None)) is not None:
            commanded.remove(one)
    return tuple(commanded)


def commands_from(recording: Recording, tick: int) -> tuple[Request, ...]:
    """Return all commands issued in a recorded run from `tick` on, those of its config too, in
    their order; of a flight recorder's run, until the end of what it kept around that tick.

    Raises `Failure` if the recording lacks some.
    """
    end = next((end for _, end in recording.kept if tick < end), None)
    issued = _issued(recording)
    return tuple(one for one in issued if tick <= one.tick and (end is None or one.tick < end))


def _issued(recording: Recording) -> list[Request]:
    """Return what the clock issued, in its order. Raises `Failure` if the recording lacks some."""
    layout = recording.layout
    found: list[tuple[int, int, Request]] = []
    for box in layout.mailboxes:
        if box.writer != CLOCK or box.name not in recording.mailboxes:
            continue
        _check_whole(box, recording, f"--from {recording.folder}")
        rows = recording.rows(box.name)
        messages = rows["message"]
        ids = messages[COMMAND_ID].tolist()
        # The clock numbers commands when it issues them.
        messages[COMMAND_ID] = 0
        for tick, number, message in zip(rows["tick"].tolist(), ids, messages, strict=True):
            found.append((tick, number, Request(layout.index(box.name), message.tobytes(), tick)))
    found.sort(key=lambda command: command[:2])
    return [request for _, _, request in found]


def _type_of(box: MailboxSpec) -> str:
    return f"{box.message} {box.version}, {box.size} bytes"


def _check_whole(box: MailboxSpec, recording: Recording, asked: str) -> None:
    if lost := recording.lost.get(box.name):
        raise Failure(f"{asked}: {box.name}: its recorder lost {lost} messages", 2)


def _rows(recording: Recording, box: MailboxSpec, is_sent: bool) -> Rows:
    """Return the messages of a mailbox as `rack.boards.wiring` has them."""
    if box.name not in recording.mailboxes:
        return []
    rows = [
        (int(row["tick"]), int(row["basis"]), row["message"].tobytes())
        for row in recording.rows(box.name)
    ]
    return [row for at, row in enumerate(rows) if is_sent or not at or row[2] != rows[at - 1][2]]
