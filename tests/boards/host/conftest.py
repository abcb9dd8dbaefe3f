"""The backplane of a rack with a bridge and a host board, without processes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import AlarmWriter
from rack.boards.config import resolve
from rack.boards.config.resolved import Resolved
from rack.boards.host.bus import HostBus
from rack.boards.host.bus_adapter import BusAdapter
from rack.boards.host.entries import OutwardEntry
from rack.boards.run.ports import InputPorts, OutputPorts
from rack.levels.references import find_class
from tests.boards.conftest import MakeConfig, MakeSegment
from tests.boards.host.test_board import HOSTED
from tests.boards.host_programs import Host

EVERY = 4
"""Ticks of a cycle of the bridge."""


class Site:
    """A backplane with the bridge's adapter and its host board's program at their ends of it."""

    def __init__(self, plan: Resolved, segment: Segment) -> None:
        self.plan = plan
        self.segment = segment
        self.host = segment.get_block("program")
        self.adapter = self.started()
        self.tick = -EVERY

    def started(self) -> BusAdapter:
        """Return an adapter, as a board that begins has it, with its ports."""
        (wiring,) = (task for task in self.plan.tasks if task.task == "bridge")
        adapter = find_class(wiring.target, BusAdapter)(wiring.context)
        adapter.attach_segment(self.segment, None)
        alarms = AlarmWriter(self.segment, "bridge")
        self.inputs = InputPorts(self.segment, adapter, wiring.inputs, alarms)
        self.outputs = OutputPorts(
            self.segment, adapter, wiring.outputs, alarms, self.inputs, wiring.sent
        )
        return adapter

    def restart(self) -> None:
        """Replace the adapter, as after the end of its board's process."""
        for writer in self.outputs.writers.values():
            writer.close()
        for _, entry in self.adapter._entries:
            if isinstance(entry, OutwardEntry):
                entry._writer.close()
        self.adapter = self.started()

    def cycle(self) -> None:
        self.tick += EVERY
        self.inputs.read(self.tick)
        self.adapter.process(self.tick)
        assert self.outputs.write(self.tick, None)

    @property
    def status(self) -> Any:
        return open_observer(self.segment, "bridge.status").peek().message

    def count(self, port: str) -> dict[str, int]:
        """Return what the newest status counts of an entry, but for what is zero."""
        record = getattr(self.status, port)
        return {name: int(record[name]) for name in record.dtype.names if record[name]}

    def crossed(self) -> list[float]:
        """Return the numbers that are in the bridge's own mailbox, oldest first."""
        reading = open_observer(self.segment, "bridge.numbers").peek()
        values = [*reading.earlier, reading.message] if reading.has_message else []
        return [message.value for message in values]


@pytest.fixture
def site(request: pytest.FixtureRequest, config: MakeConfig, make_segment: MakeSegment) -> Site:
    """The site; a test may give settings as its parameter."""
    plan = resolve(config(*getattr(request, "param", ()), text=HOSTED))
    return Site(plan, make_segment(plan.layout, ""))


@pytest.fixture
def open_bus() -> Iterator[Callable[[Site], HostBus]]:
    with ExitStack() as stack:

        def open_it(site: Site) -> HostBus:
            bus = HostBus(site.segment, site.plan.hosts[0])
            stack.callback(bus.close)
            return bus

        yield open_it


OpenBus = Callable[[Site], HostBus]


@pytest.fixture
def program(open_bus: OpenBus, site: Site) -> Host:
    return connected(open_bus(site), site)


def connected(bus: HostBus, site: Site) -> Host:
    """Return the board's program, with its ports."""
    program = Host(site.plan.hosts[0].context)
    bus.connect_ports(program)
    return program
