"""Loads the external inputs of a recorded run, so that the run can be repeated with them.

External inputs are the messages that entered through adapters, which replace host boards and other
racks in the repetition, and the commands of operators.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from rack.backplane.address_map import CLOCK
from rack.backplane.layout import MailboxSpec
from rack.backplane.message import COMMAND_ID
from rack.backplane.operator_table import Request
from rack.boards.config.commands import build_requests
from rack.boards.config.resolved import resolve
from rack.boards.config.schema import RackConfig
from rack.boards.host.adapter import Adapter
from rack.boards.wiring import MessageRows, RecordedEntries
from rack.levels.references import find_class
from rack.tools.console.answer import Failure
from rack.tools.recording.recording import Recording


def load_entries(config: RackConfig, run: Path, asked: str = "") -> dict[str, RecordedEntries]:
    """Load the messages that each adapter of a config wrote in a recorded run.

    Args:
        config: Config of the rack that will be run with these messages.
        run: Folder of the recorded run.
        asked: Command line option or request that is named at the beginning of error messages.

    Returns:
        Dictionary from adapter to the messages of its ports.

    Raises:
        ConfigError: The config has mistakes.
        Failure: The config has no adapter, the run ran in real time on a network, the recorded
            mailboxes have other types, or messages are missing from the recording.
    """
    asked = asked or f"--entries {run}"
    plan = resolve(config)
    layout = plan.layout
    recording = Recording(run)
    run_config = recording.rack_config
    if run_config.adapter.lan is not None and not run_config.is_lockstep:
        raise Failure(
            f"{asked}: it ran in real time on a network, but only lockstep runs can be repeated",
            2,
        )
    recorded = {box.name: _format_type(box) for box in recording.layout.mailboxes}
    entries: dict[str, RecordedEntries] = {}
    for task in plan.tasks:
        adapter_class = find_class(task.target, object)
        ports = (
            adapter_class.list_replayed_ports(task.context.params, layout)
            if issubclass(adapter_class, Adapter)
            else {}
        )
        if not ports:
            continue
        boxes = {port: layout.find_mailbox(f"{task.task}.{port}") for port in ports}
        for box in boxes.values():
            needed = _format_type(box)
            found = recorded.get(box.name, "no such mailbox")
            if found != needed:
                raise Failure(f"{asked}: {box.name}: {found}; needed: {needed}", 2)
            if recording.kept:
                raise Failure(f"{asked}: {recording.kept_text}", 2)
            _check_complete(box, recording, asked)
        entries[task.task] = {
            port: _load_rows(recording, box, ports[port]) for port, box in boxes.items()
        }
    if not entries:
        raise Failure(f"{asked}: '{config.name}' has no adapter", 2)
    return entries


def load_operator_commands(recording: Recording) -> tuple[Request, ...]:
    """Load the commands that operators gave in a recorded run, in order and with their ticks.

    Commands from the run's config are left out.

    Raises:
        Failure: Commands are missing from the recording.
    """
    commanded = _load_issued_commands(recording)
    if commanded and recording.kept:
        raise Failure(f"--from {recording.folder}: {recording.kept_text}", 2)
    for configured in build_requests(recording.rack_config, recording.layout):
        # In real time the config's command may have been issued after its tick. An equal command
        # issued earlier came from an operator.
        candidates = (request for request in commanded if request.tick >= configured.tick)
        matching = (
            request
            for request in candidates
            if replace(request, tick=configured.tick) == configured
        )
        if (same := next(matching, None)) is not None:
            commanded.remove(same)
    return tuple(commanded)


def load_commands_from(recording: Recording, tick: int) -> tuple[Request, ...]:
    """Load all commands issued from `tick` on in a recorded run, including the config's commands.

    For a run with a flight recorder, only commands up to the end of the recorded stretch that
    contains `tick` are loaded.

    Raises:
        Failure: Commands are missing from the recording.
    """
    end = next((end for _, end in recording.kept if tick < end), None)
    return tuple(
        request
        for request in _load_issued_commands(recording)
        if tick <= request.tick and (end is None or request.tick < end)
    )


def _load_issued_commands(recording: Recording) -> list[Request]:
    """Load the commands that the system controller issued, in order.

    Raises:
        Failure: Commands are missing from the recording.
    """
    layout = recording.layout
    numbered: list[tuple[int, int, Request]] = []
    for box in layout.mailboxes:
        if box.writer != CLOCK or box.name not in recording.mailboxes:
            continue
        _check_complete(box, recording, f"--from {recording.folder}")
        rows = recording.read_rows(box.name)
        messages = rows["message"]
        ids = messages[COMMAND_ID].tolist()
        # Clear the id, because a new one is assigned when the command is issued again.
        messages[COMMAND_ID] = 0
        numbered += [
            (tick, number, Request(layout.find_mailbox_index(box.name), message.tobytes(), tick))
            for tick, number, message in zip(rows["tick"].tolist(), ids, messages, strict=True)
        ]
    numbered.sort(key=lambda command: command[:2])
    return [request for _, _, request in numbered]


def _format_type(box: MailboxSpec) -> str:
    """Return message type, version and size of a mailbox as text, for comparison and errors."""
    return f"{box.message} {box.version}, {box.size} bytes"


def _check_complete(box: MailboxSpec, recording: Recording, asked: str) -> None:
    """Raise `Failure` if the recording lacks messages of a mailbox."""
    if lost := recording.lost_rows.get(box.name):
        raise Failure(f"{asked}: {box.name}: its recorder lost {lost} messages", 2)


def _load_rows(recording: Recording, box: MailboxSpec, is_sent: bool) -> MessageRows:
    """Return tick, basis and bytes of each recorded message of a mailbox, oldest first.

    Args:
        recording: The recording.
        box: The mailbox.
        is_sent: Whether the adapter wrote only newly arrived messages. If False, the adapter
            repeated its newest message in every cycle, and the repetitions are left out.
    """
    if box.name not in recording.mailboxes:
        return []
    rows = [
        (int(row["tick"]), int(row["basis"]), row["message"].tobytes())
        for row in recording.read_rows(box.name)
    ]
    return [
        row
        for index, row in enumerate(rows)
        if is_sent or not index or row[2] != rows[index - 1][2]
    ]
