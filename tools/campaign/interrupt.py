"""Ctrl-C of a campaign: the trial that runs is stopped, and what was done until then is reported."""

from __future__ import annotations

import signal
from types import FrameType


class Interrupt:
    """The first SIGINT or SIGTERM asks for an end in order; the second one ends the command at once."""

    def __init__(self) -> None:
        self.is_set = False
        self._kept = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def __enter__(self) -> Interrupt:
        for number in self._kept:
            signal.signal(number, self._ask)
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._kept.items():
            signal.signal(number, handler)

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.is_set = True
        for asked in self._kept:
            signal.signal(asked, signal.default_int_handler)
