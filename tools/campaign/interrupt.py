"""Ctrl-C of a campaign: the trial that runs is stopped, and what was done until then is reported."""

from __future__ import annotations

from contextlib import ExitStack

from tools.interrupt import INTERRUPT


class Interrupt:
    """While its context lasts, the first signal asks for an end in order."""

    def __init__(self) -> None:
        self._stack = ExitStack()

    @property
    def is_set(self) -> bool:
        """Whether there was a signal."""
        return INTERRUPT.number != 0

    def __enter__(self) -> Interrupt:
        self._stack.enter_context(INTERRUPT.orderly())
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()
