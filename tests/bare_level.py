"""A level without ports of its own: what a task reads and writes is in `ports`, by name."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

from rack.backplane.mailbox.queue import UNLIMITED
from rack.levels.level import Executor, LevelContext


class BareLevel(Executor):
    """Does nothing; takes `most` messages of a queue in a cycle."""

    def __init__(self) -> None:
        super().__init__(cast(LevelContext, SimpleNamespace(sizes={})))
        self.most = UNLIMITED

    def max_messages(self, port: str) -> int:
        return self.most

    def process(self, tick: int) -> None:
        """Do nothing."""
