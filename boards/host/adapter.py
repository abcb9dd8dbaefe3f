"""Base class of adapters, which use the segment directly and may connect to the outside."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from rack.backplane.layout import Layout
from rack.backplane.message import AnyMessage
from rack.backplane.segment import Segment
from rack.boards.wiring import RecordedEntries
from rack.levels.level import Executor, LevelContext, Reading

STATUS = "status"


class Adapter(Executor):
    """Board that passes messages between the backplane and the outside.

    Attributes:
        readings: Readings of its inputs, keyed by port. They are not attributes of the level,
            because an input and an output may have the same name.
    """

    wired_by: ClassVar[str]
    """Key in the table of the adapter's board under which the ports are listed."""
    joins_sides: ClassVar[bool] = False
    """Whether the adapter connects tasks with host boards and reads mailboxes of both sides."""

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.readings: dict[str, Reading[AnyMessage]] = {}

    def find_input_table(self, port: str) -> dict[str, Any]:
        """Return the table in which the board stores the readings of a port."""
        return self.readings

    @classmethod
    def list_replayed_ports(cls, params: Mapping[str, Any], layout: Layout) -> Mapping[str, bool]:
        """Return the output ports whose recorded messages a replay writes again.

        Args:
            params: Parameters of the adapter's board.
            layout: Layout of the rack.

        Returns:
            A dictionary from each such port to True if its messages are sent one by one, otherwise
            False. Empty if the adapter runs in a replay as in any other run.
        """
        return {}

    def attach_segment(self, segment: Segment, entries: RecordedEntries | None) -> None:
        """Open the mailboxes that the adapter accesses without ports.

        The board calls this before the self-test.

        Args:
            segment: Segment of the rack.
            entries: In a replay, the recorded messages from outside, keyed by port. Otherwise None.
        """

    def open_connections(self) -> None:
        """Open connections to the outside.

        The board has already set its core and priority, which new threads inherit.
        """
