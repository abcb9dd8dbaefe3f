"""Ctrl-C of a campaign: the trial that runs is stopped, and what was done until then is reported."""

from __future__ import annotations

from contextlib import ExitStack

from rack.tools.console.interrupt import INTERRUPT

BOUND_S = 30.0
"""A report of hours of trials is worth more than 2 s; a second signal ends the campaign at once."""


class Interrupt:
    """While its context lasts, the first signal asks for an end in order."""

    def __init__(self) -> None:
        self._stack = ExitStack()

    @property
    def is_set(self) -> bool:
        """Whether there was a signal."""
        return INTERRUPT.number != 0

    def __enter__(self) -> Interrupt:
        self._stack.enter_context(INTERRUPT.orderly(bound_s=BOUND_S))
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()
