"""A level for tests of faults: it drives something that sensors and motors can fail of."""

from __future__ import annotations

from backplane.message import Field, status
from boards.faults.kinds import KINDS
from levels.level import Executor, Ports

PLACE = status("place", 1, Field("position", "f8", "rad", "where it is"), Field("mode", "i2", "1", "how it moves"))


class Driven(Executor):
    """Says that it stands."""

    outputs = {"status": PLACE}
    faults = tuple(kind.name for kind in KINDS if kind.where == "arm")

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Say where it is."""
        write.status.position = 0.5
