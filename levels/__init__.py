"""Virtual control loops: the public API for authors of levels.

`rack.levels.level` describes the duties of a level.

- Write a level: `Executor`, `Planner`, with the ports `Input`, `Inputs`, `Output`, `QueuedOutput`
  and `TimedOutput`, with `Reading`, `Verdict`, `Program`, `LevelContext`, `Pace`.
- Declare messages: `Message`, `Command`, `Status`, `field`, `State`. The messages of the default
  levels are in `rack.levels.messages`, their error codes in `Error`.
- Declare parameters: `Table`, `Positive`, `Finite`, `Live`, `read_params`, `set_live`. Arm and
  cell are described by `RobotConfig` and `SceneConfig`.
- Obey an operator: `Orders`, `Operation`, `Goal`, `Commands`, `OperatorCommand`, `AnsweringStatus`,
  `RelayedCommand`.
- Protect the arm: obey a `Demand` of the rack, report a `Finding` with an `Alarm`, and apply an
  injected `Fault`.
- Report events: declare a `FindingKind` and call `Executor.raise_finding`.
- Raise errors: `LevelError`, `RobotError`, `ProgramError`, `Refused`.

Import everything else from its module, because MuJoCo takes half a second to import:
`rack.levels.algebra` (arithmetic with the same bits on every processor), `rack.levels.robot` (cell,
limits, dynamics), `rack.levels.arm` (the arm's interface), and the default levels: `servo`,
`primitive`, `elemental_move`, `task`, `world`, `figures`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from rack.backplane.exports import build_lazy_getattr

if TYPE_CHECKING:
    from rack.backplane.message import Command, Message, State, Status, field
    from rack.backplane.watch.alarms import Alarm
    from rack.levels.errors import LevelError, ProgramError, Refused, RobotError
    from rack.levels.level import (
        Demand,
        Executor,
        Fault,
        Finding,
        FindingKind,
        Input,
        Inputs,
        LevelContext,
        Output,
        Pace,
        Planner,
        Program,
        QueuedOutput,
        Reading,
        TimedOutput,
        Verdict,
    )
    from rack.levels.messages import Error
    from rack.levels.operator import (
        AnsweringStatus,
        Commands,
        Goal,
        Operation,
        OperatorCommand,
        Orders,
        RelayedCommand,
    )
    from rack.levels.tables import (
        Finite,
        Live,
        Positive,
        RobotConfig,
        SceneConfig,
        Table,
        read_params,
        set_live,
    )

__all__ = [
    "Alarm",
    "AnsweringStatus",
    "Command",
    "Commands",
    "Demand",
    "Error",
    "Executor",
    "Fault",
    "Finding",
    "FindingKind",
    "Finite",
    "Goal",
    "Input",
    "Inputs",
    "LevelContext",
    "LevelError",
    "Live",
    "Message",
    "Operation",
    "OperatorCommand",
    "Orders",
    "Output",
    "Pace",
    "Planner",
    "Positive",
    "Program",
    "ProgramError",
    "QueuedOutput",
    "Reading",
    "Refused",
    "RelayedCommand",
    "RobotConfig",
    "RobotError",
    "SceneConfig",
    "State",
    "Status",
    "Table",
    "TimedOutput",
    "Verdict",
    "field",
    "read_params",
    "set_live",
]
_PLACES = {
    "rack.backplane.message": ("Command", "Message", "State", "Status", "field"),
    "rack.backplane.watch.alarms": ("Alarm",),
    "rack.levels.errors": ("LevelError", "ProgramError", "Refused", "RobotError"),
    "rack.levels.level": (
        "Demand",
        "Executor",
        "Fault",
        "Finding",
        "FindingKind",
        "Input",
        "Inputs",
        "LevelContext",
        "Output",
        "Pace",
        "Planner",
        "Program",
        "QueuedOutput",
        "Reading",
        "TimedOutput",
        "Verdict",
    ),
    "rack.levels.messages": ("Error",),
    "rack.levels.operator": (
        "AnsweringStatus",
        "Commands",
        "Goal",
        "Operation",
        "OperatorCommand",
        "Orders",
        "RelayedCommand",
    ),
    "rack.levels.tables": (
        "Finite",
        "Live",
        "Positive",
        "RobotConfig",
        "SceneConfig",
        "Table",
        "read_params",
        "set_live",
    ),
}

# A type checker would accept every misspelt name if it saw `__getattr__`.
if not TYPE_CHECKING:
    __getattr__ = build_lazy_getattr(__name__, _PLACES)
