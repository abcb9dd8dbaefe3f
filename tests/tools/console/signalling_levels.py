"""A level that sends its launcher a signal at the moment MOMENT, SIGNALS times."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from tests.processes import parent_of
from tests.two_levels import Upper

TICK = 24


def launcher() -> int:
    """Return the launcher: the parent of the child that tries this module, or this process."""
    parent = os.getppid()
    is_tried = b"rack.tools.cli" in Path(f"/proc/{parent}/cmdline").read_bytes()
    return parent if is_tried else os.getpid()


def send(moment: str) -> None:
    """Send the signals if this is their moment."""
    if os.environ["MOMENT"] == moment:
        # The launcher tries it in a child and starts the crate; the crate forks the boards.
        here = {"config": launcher, "crate": os.getppid}.get(
            moment, lambda: parent_of(os.getppid())
        )
        for number in os.environ["SIGNALS"].split():
            os.kill(here(), int(number))


send("crate" if sys.argv[0].endswith("crate/__main__.py") else "config")


class Signalling(Upper):
    """Counts, and sends the signals."""

    def self_test(self) -> None:
        """Send during the launch, when there is a segment."""
        send("self-test")

    def process(self, tick: int) -> None:
        """Send during the run."""
        super().process(tick)
        if tick == TICK:
            send("cycle")

    def close(self) -> None:
        """Send while the rack is taken down."""
        send("close")
