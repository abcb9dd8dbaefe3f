"""Exceptions of the levels, with an example of each.

`LevelError` is the root.

- `CannotGoOn`: in lockstep, the network adapter of another rack has a different cycle length. The
  board is not restarted.
- `RobotError`: an MJCF file is missing or malformed, or the model lacks a joint or a site.
- `ProgramError`: a task program names an unknown object, verb or place.
- `Refused`: a command cannot be carried out. A planner turns it into a status with its code and
  reason.
- `RunOver`: a host program waits for an answer, and the run ends.
"""

from __future__ import annotations


class LevelError(Exception):
    """Root of all errors that this package raises. The text is one line for the user."""


class CannotGoOn(LevelError):
    """A level cannot continue, and a restart would not help."""


class RunOver(LevelError):
    """A call of a host program cannot be completed because the run is over."""


class RobotError(LevelError):
    """A robot or a cell cannot be built from its description."""


class ProgramError(LevelError):
    """A task program is invalid."""


class Refused(LevelError):
    """A command cannot be carried out.

    Attributes:
        code: One of `rack.levels.messages.Error`.
        action: Number of the refused action in a program. None if the command is not part of one.
    """

    def __init__(self, code: int, reason: str, action: int | None = None) -> None:
        super().__init__(reason)
        self.code = int(code)
        self.action = action
