"""The exceptions of the levels, with an example of each.

`LevelError` is the root.

- `CannotGoOn`: another rack's adapter has a cycle of another length, in lockstep; its board is not
  restarted.
- `RobotError`: an MJCF file is missing or malformed; the model lacks a joint or a site.
- `ProgramError`: a task program names an unknown object, verb or place.
- `Refused`: a command cannot be carried out; a planner turns it into a status with its code and
  reason.
"""

from __future__ import annotations


class LevelError(Exception):
    """Root of every error this package raises; its text is one line for the user."""


class CannotGoOn(LevelError):
    """A level that cannot go on, and that a restart would not help."""


class RobotError(LevelError):
    """A robot or a cell that cannot be built from its description."""


class ProgramError(LevelError):
    """A task program that cannot be understood."""


class Refused(LevelError):
    """A command that cannot be carried out: `code` is one of `rack.levels.messages.Error`,
    `action` the number of the refused action, where a program has several.
    """

    def __init__(self, code: int, reason: str, action: int | None = None) -> None:
        super().__init__(reason)
        self.code = int(code)
        self.action = action
