"""The two sides of a rack: real time, and the host side. Only a bus adapter reads on one and writes on the other."""

from __future__ import annotations

from collections.abc import Container, Iterator, Sequence

from rack.boards.config.ports import TaskPorts, table_of
from rack.boards.errors import Mistake
from rack.boards.host.adapter import Adapter
from rack.boards.host.bus_adapter import BusAdapter

PASS_IT = "pass it through a bus adapter: [board.<bridge>.params.pass]"


class Sides:
    """The side of every mailbox: `from_host` are written by host boards, `to_host` by bus adapters for host boards."""

    def __init__(self, ports: Sequence[TaskPorts]) -> None:
        self._ports = ports
        self.from_host = {box for task in ports if task.place.role == "host" for box in task.writes.values()}
        self._sources = {
            f"{task.place.board}.{port}": source
            for task in ports
            if issubclass(task.kind, BusAdapter)
            for port, source in task.sources
        }
        self.to_host = {box for box, source in self._sources.items() if source not in self.from_host}

    @property
    def of_host(self) -> set[str]:
        """The mailboxes of the host side."""
        return self.from_host | self.to_host

    def mistakes(self, unknown: Container[str]) -> Iterator[Mistake]:
        """Yield a mistake for every port that reads a mailbox of the other side; not of boards in `unknown`."""
        for task in self._ports:
            for port, mailbox in task.sources:
                if mailbox.partition(".")[0] not in unknown and (why := self._reason(task, mailbox)):
                    yield Mistake(f"{table_of(task.place)}.{key_of(task)}.{port}", mailbox, why)

    def _reason(self, task: TaskPorts, mailbox: str) -> str:
        """Return why a task or host board must not read a mailbox; empty if it may."""
        is_host, name = task.place.role == "host", task.place.board
        if issubclass(task.kind, BusAdapter):
            return "it is on the host side already" if mailbox in self.to_host else ""
        if is_host == (mailbox in self.of_host):
            return ""
        side = "real-time" if mailbox not in self.of_host else "host"
        if (source := self._sources.get(mailbox)) is not None:
            writer, same = source.partition(".")[0], "host" if is_host else "real-time"
            return f"a bus adapter joins the two sides; '{writer}' and '{name}' are both on the {same} side"
        return f"it is on the {side} side; {PASS_IT}"


def key_of(task: TaskPorts) -> str:
    """Return the key of a board under which its ports are wired."""
    if issubclass(task.kind, Adapter):
        return task.kind.wired_by
    return "planner_reads" if task.place.role == "planner" else "reads"
