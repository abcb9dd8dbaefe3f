"""What bus adapters have in common: they see the segment itself, and may open something outside the
rack.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar

from rack.backplane.layout import Layout
from rack.backplane.message import AnyMessage
from rack.backplane.segment import Segment
from rack.boards.wiring import Entries
from rack.levels.level import Executor, LevelContext, Reading

STATUS = "status"


class Adapter(Executor):
    """A board that passes messages between the backplane and what is not on it."""

    wired_by: ClassVar[str]
    """Key of its board under which its ports are listed."""
    joins_sides: ClassVar[bool] = False
    """Whether what is not on the backplane are host boards: it reads on both sides."""

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.readings: dict[str, Reading[AnyMessage]] = {}
        """What it has read, by port: a port that it writes may have the same name."""

    def input_table(self, port: str) -> dict[str, Any]:
        """Return where the board puts what it has read."""
        return self.readings

    @classmethod
    def replayed(cls, params: Mapping[str, Any], layout: Layout) -> Mapping[str, bool]:
        """Return the ports that a replay gives out as they were recorded, and whether it sends
        their messages one by one; without any, the adapter runs as ever.
        """
        return {}

    def attach(self, segment: Segment, entries: Entries | None) -> None:
        """Take the segment, before the self-test; in a replay with what was recorded in place of
        what is out.
        """

    def open(self) -> None:
        """Open the way outside. The board has its core and priority by now: threads that this
        starts inherit both.
        """
