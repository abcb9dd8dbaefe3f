"""Inventory of a config.

It lists the tasks, the mailboxes with their bus addresses, the host side and the network, and
states how an arm behaves without new torques.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

from rack.backplane.address_map import AddressMap
from rack.backplane.layout import Layout
from rack.boards.config.cell import build_rack_cell
from rack.boards.config.schema import CLOCK_SLOT, LAN, RackConfig
from rack.boards.timing.chains import format_names
from rack.levels.level import Executor
from rack.levels.references import find_class
from rack.levels.tables import read_params
from rack.tools.console.answer import Document
from rack.tools.console.tables import Blocks, Cell, TextTable

PATIENCE_LINE = (
    "patience: '{board}' keeps its last torque for {ms:g} ms ({cycles} cycles; at most"
    " {permitted_ms} ms). In this time joints at full speed turn {angle_mrad} mrad, and all motors"
    " at full torque add {energy_j} J"
)
MONITORS_LINE = (
    "monitors: '{board}' accepts samples with errors of {position_mrad} mrad,"
    " {velocity_mrad_s} mrad/s; or, at full speed, {jitter_ms} ms early or late"
)


def build_inventory(config: RackConfig, layout: Layout, notes: list[str]) -> Document:
    """Return the inventory of a config as plain data.

    Addresses and sizes are in bytes. `slice_ms` of a task and `delay_ms` of a mailbox are the time
    from a release until the messages are visible. `depth` is the number of slots of a mailbox,
    `size` the size of one message, and `capacity` the largest number of unread messages in a queue,
    or 0 for other mailboxes.

    Args:
        config: Config of the rack.
        layout: Layout of its segment.
        notes: Remarks to be shown.
    """
    addresses = AddressMap(layout)
    tick_ms = layout.clock_ns * 1e-6
    tasks = [
        {
            "slot": task.slot,
            "task": task.name,
            "core": task.core,
            "priority": task.priority,
            "rate_hz": 1e9 / (task.every * layout.clock_ns),
            "every_ticks": task.every,
            "phase_ticks": task.phase,
            "slice_ms": task.slice * tick_ms,
            "trace_address": addresses.traces[task.name],
        }
        for task in sorted(layout.tasks, key=lambda t: (t.slot, t.role))
    ]
    mailboxes = [
        {
            "address": addresses.mailboxes[mailbox.name],
            "mailbox": mailbox.name,
            "message": f"{mailbox.message} {mailbox.version}",
            "size": mailbox.size,
            "depth": mailbox.depth,
            "protocol": mailbox.protocol,
            "capacity": mailbox.capacity,
            "writer": mailbox.writer,
            "readers": mailbox.readers,
            "delay_ms": mailbox.delay * tick_ms,
        }
        for mailbox in layout.mailboxes
    ]
    return {
        "rack": config.name,
        "mode": config.clock.mode,
        "clock_ms": tick_ms,
        "clock_core": config.clock.core,
        "clock_priority": config.clock.priority,
        "segment_bytes": addresses.size,
        "windows": addresses.windows,
        "tasks": tasks,
        "hosts": [
            {
                "board": name,
                "program": host.program,
                "external": host.external,
                "writes": [mailbox.name for mailbox in layout.mailboxes if mailbox.writer == name],
                "reads": [mailbox.name for mailbox in layout.mailboxes if name in mailbox.readers],
            }
            for name, host in config.host.items()
        ],
        "network": _describe_network(config),
        "patience": list(_describe_patience(config, layout)),
        "monitors": list(_describe_monitors(config)),
        "mailboxes": mailboxes,
        "notes": notes,
    }


def _describe_patience(config: RackConfig, layout: Layout) -> Iterator[Document]:
    """Yield how long each arm or hand continues without new torques, and how far it can move."""
    for board in [box.writer for box in layout.mailboxes if box.message == "arm_state"]:
        cell = build_rack_cell(config)
        every = config.find_period(board)
        tick_ms = layout.clock_ns * 1e-6
        ticks = cell.patience.ticks(every, tick_ms * 1e-3)
        angle_mrad = ticks * tick_ms * cell.bounds.velocity
        yield {
            "board": board,
            "ms": ticks * tick_ms,
            "cycles": ticks // every,
            "permitted_ms": round(cell.patience.seconds * 1e3, 3),
            "angle_mrad": angle_mrad.round(1).tolist(),
            "energy_j": round(float((angle_mrad * cell.bounds.torque).sum()) * 1e-3, 3),
        }


def _describe_monitors(config: RackConfig) -> Iterator[Document]:
    """Yield, for each arm, the largest sensor errors at which its brakes do not engage."""
    robot = config.robot
    if robot is None:
        return
    # MuJoCo takes 0.5 s to import, so import it only for racks with an arm.
    from rack.levels.arm import find_arm
    from rack.levels.robot.cell import replace_encoders
    from rack.levels.servo.control import ArmParams
    from rack.levels.servo.sensor_monitor import compute_tolerance

    for board, table in config.board.items():
        kind = find_class(table.executor, Executor).params
        if kind is None or not issubclass(kind, ArmParams):
            continue
        sensors = find_arm(read_params(kind, table.params).arm).sensors
        limits = compute_tolerance(replace_encoders(build_rack_cell(config), robot, sensors))
        yield {
            "board": board,
            "position_mrad": (1e3 * limits.position).round(3).tolist(),
            "velocity_mrad_s": (1e3 * limits.velocity).round(3).tolist(),
            "jitter_ms": round(1e3 * limits.jitter_s, 3),
        }


def _describe_network(config: RackConfig) -> Document | None:
    """Return the exchanges of a rack with others as plain data. None without a network."""
    table = config.adapter.lan
    if table is None:
        return None
    entries = [
        {
            "entry": f"{LAN}.{port}",
            "way": direction,
            "mailbox": entry.source,
            "rate_hz": entry.rate_hz,
            "max_age_ms": getattr(entry, "max_age_ms", None),
        }
        for direction, ports in (("out", table.exports), ("in", table.imports))
        for port, entry in ports.items()
    ]
    keys = ("listen", "connect", "lease_ms", "on_peer_loss")
    return {**{key: getattr(table, key) for key in keys}, "peers": table.racks, "entries": entries}


def format_inventory(data: Document) -> Blocks:
    """Yield an inventory as text for the terminal."""
    boards = len({task["slot"] for task in data["tasks"]})
    crate = f"{boards} board{'s' * (boards > 1)} and the clock"
    yield f"rack {data['rack']}: {crate}, {data['clock_ms']:g} ms, {data['mode']}"
    yield from data["notes"]
    clock = {
        **dict.fromkeys(data["tasks"][0], ""),
        "slot": CLOCK_SLOT,
        "task": "clock",
        "core": data["clock_core"],
        "priority": data["clock_priority"],
    }
    yield ""
    yield _build_table([clock, *data["tasks"]], ("phase ticks", "trace address", "slice ms"))
    if data["hosts"]:
        yield ""
        yield _build_table(data["hosts"], ("external", "program"))
    if (network := data["network"]) is not None:
        peers = ", ".join(network["peers"]) or "no rack in particular"
        ends = [f"{key} {', '.join(network[key])}" for key in ("listen", "connect") if network[key]]
        rule = f"lost after {network['lease_ms']:g} ms: {network['on_peer_loss']}"
        yield ""
        yield f"network: {'; '.join([*ends, f'works with {peers}', rule])}"
        yield _build_table(network["entries"])
    yield ""
    yield _build_table(data["mailboxes"], ("depth", "size", "message", "capacity", "protocol"))
    yield ""
    windows = ", ".join(
        f"{board} {_format_address(address)}" for board, address in data["windows"].items()
    )
    yield f"segment: {data['segment_bytes']} bytes; board windows: {windows}"


def _build_table(records: Sequence[Document], dropped: Sequence[str] = ()) -> TextTable:
    """Return a table of records of an inventory.

    Args:
        records: The records, with the same keys, which become the columns.
        dropped: Columns that a narrow terminal leaves out, in that order.
    """
    return TextTable(
        [{key.replace("_", " "): _format_cell(key, each[key]) for key in each} for each in records],
        dropped,
    )


def _format_cell(key: str, value: Any) -> Cell:
    """Return a value of a record as a cell."""
    if key.endswith("address") and value:
        return _format_address(value)
    return format_names(value) if isinstance(value, list | tuple) else value


def format_arm_lines(data: Document) -> Iterator[str]:
    """Yield the lines on the behaviour of an arm without torques and on its monitors."""
    yield from (PATIENCE_LINE.format(**each) for each in data["patience"])
    yield from (MONITORS_LINE.format(**each) for each in data["monitors"])


def _format_address(address: int) -> str:
    """Format a bus address as a hexadecimal number with at least six digits."""
    return f"0x{address:06x}"
