"""How much of a run is read, where that takes a while."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

PATIENCE_S = 2.0
"""Time that passes in silence."""


@contextmanager
def part_for(silent: bool) -> Iterator[Callable[[float], None]]:
    """Give what is told which part is done, 0 to 1; it shows it on stderr, every two seconds."""
    shown = time.monotonic()

    def told(part: float) -> None:
        nonlocal shown
        if not silent and time.monotonic() - shown > PATIENCE_S:
            shown = time.monotonic()
            print(f"reading the run: {part:.0%}", file=sys.stderr, flush=True)

    yield told
