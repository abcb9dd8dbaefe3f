"""Operator's commands to any level: operations, messages, and their handling by a level.

An operator may command every level that reads "own.operator" and declares `commands`, in addition
to the level above it or instead of it. The level handles the commands with `Orders`. Its status
derives from `AnsweringStatus`, its command from `RelayedCommand`. The field `operator` is passed
down with every command, so that the lowest status shows on which operator's command its torque is
based. This makes the system's response measurable.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from enum import IntEnum
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rack.backplane.mailbox.mailbox import Reading
from rack.backplane.message import REASON_BYTES, AnyMessage, Command, Status, field, integer_field

if TYPE_CHECKING:
    from numpy.typing import NDArray

MAX_JOINTS = 16
"""Maximum number of joints of an arm.

It is fixed, because an operator's mailbox has the same layout in every rack.
"""
MAX_NAME_BYTES = 64
"""Maximum length of a name in a command, in bytes."""


class Operation(IntEnum):
    """Commands of an operator."""

    NONE = 0
    HOLD = 1  # come to rest, and stay until RESUME
    RESUME = 2  # return to normal work
    SETPOINT = 3  # move the joints to positions, and stay until RESUME
    GOTO = 4  # plan and make a motion to a goal, and stay until RESUME
    MODIFY = 5  # switch the control modification `name` on or off
    TABLE = 6  # switch to the state table `name`
    DO = 7  # execute the level's own command `name`, not those from above, until RESUME
    ENABLE = 8  # enable the arm's drives
    DISABLE = 9  # brake the arm, and disable its drives
    RESET = 10  # reset the fault of the arm's drives
    RELEASE = 11  # end the bring-up and permit full speed
    SET = 12  # set a live parameter of the level; `name` is key=value
    SCHEDULE = 13  # change the scheduler of the level's board, which does this, to `name`
    SWITCH = 14  # hand over to a standby, which the clock does


class Goal(IntEnum):
    """Forms in which a command gives its goal."""

    NONE = 0
    JOINTS = 1  # joint positions
    POSE = 2  # position and orientation of the tool
    DIRECTION = 3  # position of the tool and direction of its z axis, any turn about it
    HOME = 4  # home position of the arm
    ON = 5
    OFF = 6


SETTINGS = (Operation.MODIFY, Operation.TABLE, Operation.SET, Operation.SCHEDULE)
"""Operations that are done at once and do not replace the command in force (see `Orders`).

Each gives the name of what it sets.
"""
CLOCK_OPERATIONS = (Operation.SCHEDULE, Operation.SWITCH)
"""Operations on the board of the level, which the clock carries out."""
DRIVE_OPERATIONS = (Operation.ENABLE, Operation.DISABLE, Operation.RESET, Operation.RELEASE)
"""Operations on the arm itself, which do not replace the command in force either."""
PASSING_OPERATIONS = (*SETTINGS, *CLOCK_OPERATIONS, *DRIVE_OPERATIONS)
"""All operations that do not replace the command in force."""
NAMED_OPERATIONS = (*SETTINGS, Operation.DO)
"""Operations that give a name: see `Executor.list_operation_names`."""


class Answer(IntEnum):
    """A level's answer to its operator's newest command."""

    NONE = 0  # there was none
    TAKEN = 1  # being executed
    DONE = 2
    REFUSED = 3  # the level continues as before


class OperatorCommand(Command, version=2):
    """An operator's command to a level."""

    what: Operation = field(doc="what to do")
    goal: Goal = field(doc="form of the goal")
    count: int = integer_field("joints that follow", "u1")
    joints: np.ndarray = field(unit="rad", doc="joint positions, for goal joints", shape=MAX_JOINTS)
    position: np.ndarray = field(unit="m", doc="of the tool, for goals pose and direction", shape=3)
    quaternion: np.ndarray = field(unit="1", doc="of the tool, for goal pose", shape=4)
    direction: np.ndarray = field(unit="1", doc="of the tool's z axis, for goal direction", shape=3)
    name: str = field(
        f"S{MAX_NAME_BYTES}", doc="what a setting sets, or the level's own command to do"
    )


RESTS_ON = integer_field(
    "newest operator's command, at this level or above, on which this is based (0: none)"
)


class RelayedCommand(Command):
    """Base class for commands that relay the operator's command on which they are based."""

    operator: int = RESTS_ON


class SampledCommand(RelayedCommand):
    """Base class for commands that state the sample of arm or hand on which they are based."""

    sampled: int = field(unit="tick", doc="tick of the status on which it is based (-1: none yet)")


class AnsweringStatus(Status):
    """Base class for statuses that answer an operator."""

    operator: int = RESTS_ON
    order: int = integer_field("operator's command that this answers, new or not (0: none yet)")
    answer: Answer = field(doc="this level's answer to it")
    standing: Operation = field(
        doc="operator's operation in force (0: none, the level does its normal work)"
    )
    objection: str = field(f"S{REASON_BYTES}", doc="why it was refused, readable")


Commands = Mapping[Operation, Sequence[Goal]]
HOLD_COMMANDS: Commands = {Operation.HOLD: (), Operation.RESUME: ()}
"""The commands of a level that an operator can only hold and resume."""

EFFECTS = {
    Operation.HOLD: "held",
    Operation.SETPOINT: "kept at a set point",
    Operation.GOTO: "diverted",
    Operation.DO: "commanded",
}
"""Effect on a level of an operation in force, as text."""
HELD_FROM_ABOVE = "held by the level above"
"""Reason that a level reports while the level above holds it.

The level above does not repeat this reason in its own status.
"""
ABOVE_LOST = "no command from the level above: held until its board is back"
BELOW_LOST = "no status from the level below: waiting for its board"


def format_commands(commands: Commands) -> str:
    """Return the commands of a level as text, such as "hold, resume, goto joints|pose"."""
    return ", ".join(
        f"{operation.name.lower()} {format_goals(goals)}".rstrip()
        for operation, goals in commands.items()
    )


def format_goals(goals: Sequence[Goal]) -> str:
    """Return goal forms as one word, such as "joints|pose"."""
    return "|".join(goal.name.lower() for goal in goals)


def describe_command(what: int, goal: int) -> str:
    """Return a command as text, such as "goto pose". Unknown values are shown as numbers."""
    names = [
        kind(number).name.lower() if number in set(kind) else str(number)
        for kind, number in ((Operation, what), (Goal, goal))
    ]
    return " ".join(names[: 1 + (goal != Goal.NONE)])


class _CommandAnswer(NamedTuple):
    """The answer to one command."""

    serial: int  # of the command
    answer: Answer
    objection: str = ""  # why the command was refused. Empty if it was not


class Orders:
    """Operator's commands to one level, and the answers to them.

    The command in force is the newest command that was not refused and is neither one of `SETTINGS`
    nor one of `DRIVE_OPERATIONS`. While it is in force, the level does not do its normal work,
    unless the command is RESUME. After a restart, the board processes all commands again in order,
    so that the same command is in force again. If a setting or a refused command arrives before the
    command in force is done, both are answered. A status shows one answer at a time. If there are
    several answers in one cycle, the following cycles show them, oldest first.
    """

    def __init__(self, commands: Commands) -> None:
        self._commands = commands
        # Operation in force, one of `EFFECTS`. NONE while the level does its normal work.
        self.standing = Operation.NONE
        self.serial = 0  # serial of the newest command. 0 if none yet
        self.basis = 0  # serial of the newest command that was not refused. 0 if none yet
        self._in_force = _CommandAnswer(0, Answer.NONE)
        # State before the newest command, which is restored if that command is refused.
        self._before = self.basis, self.standing, self._in_force
        # Answers that no status has shown, by the serials of their commands, oldest first.
        self._news: dict[int, _CommandAnswer] = {}
        self._shown = self._in_force

    @property
    def in_force(self) -> int:
        """Serial of the command in force. 0 if there is none yet."""
        return self._in_force.serial

    @property
    def answer(self) -> Answer:
        """Answer to the command in force."""
        return self._in_force.answer

    @property
    def is_in_force(self) -> bool:
        """True if a command other than RESUME is in force and suspends the normal work."""
        return self.standing is not Operation.NONE

    @property
    def is_holding(self) -> bool:
        """True if the operation in force is HOLD."""
        return self.standing is Operation.HOLD

    def take_commands(
        self,
        operator: Reading[OperatorCommand],
        judge: Callable[[OperatorCommand], None] | None = None,
    ) -> bool:
        """Process the new commands of the operator's mailbox.

        Args:
            operator: Reading of the mailbox.
            judge: Function to call with each accepted command, which checks it or applies a
                setting. It may refuse the command by calling `refuse_newest`. None if the level has
                nothing to check or set.

        Returns:
            True if a command other than a setting or an operation on the drives was accepted.
        """
        if not operator.is_new:
            return False
        taken = False
        for message in (*operator.earlier, operator.message):
            replaced = self.in_force
            if self._accept_command(message):
                taken |= message.what not in PASSING_OPERATIONS
                if judge is not None and message.what not in CLOCK_OPERATIONS:
                    judge(message)
            if self.in_force != replaced:
                self._news.pop(replaced, None)
        return taken

    def _accept_command(self, message: OperatorCommand) -> bool:
        """Accept or refuse a command, unless it was processed before. Return True if accepted."""
        # A clock board that is restarted while it sends a command sends it again.
        if message.id <= self.serial:
            return False
        self._before = self.basis, self.standing, self._in_force
        self.serial = message.id
        operation = message.what
        goal = message.goal
        known = {**self._commands, **dict.fromkeys(CLOCK_OPERATIONS, ())}
        if operation not in known or goal not in (known[operation] or (Goal.NONE,)):
            self.refuse_newest(
                f"{describe_command(operation, goal)} is not a command of this level; permitted:"
                f" {format_commands(self._commands)}"
            )
            return False
        self.basis = self.serial
        is_done = operation in (
            Operation.RESUME,
            Operation.RELEASE,
            *CLOCK_OPERATIONS,
            *SETTINGS,
        )
        answer = _CommandAnswer(self.serial, Answer.DONE if is_done else Answer.TAKEN)
        if operation not in PASSING_OPERATIONS:
            self.standing = (
                Operation.NONE if operation == Operation.RESUME else Operation(operation)
            )
            self._in_force = answer
        self._queue_answer(answer)
        return True

    def refuse_newest(self, why: str) -> None:
        """Refuse the newest command, and restore the command that was in force before it."""
        self.basis, self.standing, self._in_force = self._before
        self._queue_answer(_CommandAnswer(self.serial, Answer.REFUSED, why))

    def abandon_command(self, why: str) -> None:
        """Abandon the command in force and hold. The answer to it becomes REFUSED, with `why`."""
        self.standing = Operation.HOLD
        self._answer_command_in_force(Answer.REFUSED, why)

    def report_under_way(self) -> None:
        """Report that the command in force, a RESUME, is not completed yet."""
        self._answer_command_in_force(Answer.TAKEN)

    def report_done(self) -> None:
        """Report that the command in force is done. It remains in force."""
        if self.answer is Answer.TAKEN:
            self._answer_command_in_force(Answer.DONE)

    def report_setting_started(self) -> None:
        """Report that the newest setting takes time. Call `report_completed` afterwards."""
        self._queue_answer(_CommandAnswer(self.serial, Answer.TAKEN))

    def report_completed(self, serial: int) -> None:
        """Report that command `serial` is done: one to the drives, or a setting that took time."""
        self._queue_answer(_CommandAnswer(serial, Answer.DONE))

    def format_reason(self, board: str) -> str:
        """Return the reason why an operator's command suspends the work of level `board`, as text.

        Empty if no command suspends it.
        """
        if self.answer is Answer.REFUSED:
            return f"{board} held, `resume` releases it: {self._in_force.objection}"
        effect = EFFECTS.get(self.standing)
        return f"{board} {effect} by the operator: `resume` releases it" if effect else ""

    def _answer_command_in_force(self, answer: Answer, why: str = "") -> None:
        """Change the answer to the command in force, and queue it."""
        self._in_force = _CommandAnswer(self.in_force, answer, why)
        self._queue_answer(self._in_force)

    def _queue_answer(self, answer: _CommandAnswer) -> None:
        """Queue an answer for the status. It replaces an older answer to the same command."""
        self._news[answer.serial] = answer

    def find_basis(self, above: int) -> int:
        """Return the serial of the newest operator command on which this cycle is based.

        `above` is the serial in the field `operator` of the command from the level above.
        """
        return max(self.basis, above)

    def fill_status(self, status: AnsweringStatus, above: int = 0) -> None:
        """Write the oldest queued answer to a status, or repeat the last one if none is queued.

        For `above` see `find_basis`.
        """
        if self._news:
            self._shown = self._news.pop(next(iter(self._news)))
        status.operator = self.find_basis(above)
        status.order = self._shown.serial
        status.answer = self._shown.answer
        status.standing = self.standing
        status.objection = self._shown.objection


def find_answered_serial(status: AnsweringStatus | AnyMessage) -> int:
    """Return the serial of the newest command that a level had processed when it wrote a status.

    A restarted board needs it to avoid executing a command twice.
    """
    # The status may show a late answer to an earlier command.
    return max(status.order, status.operator)


def read_joint_goal(
    message: OperatorCommand, names: Sequence[str], ranges: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the joint positions of an `OperatorCommand`, (joints,), in rad.

    Args:
        message: The command.
        names: Names of the joints.
        ranges: Permitted positions, (joints, 2), rad.

    Raises:
        ValueError: The number of joints is wrong, or a position is outside its range.
    """
    if message.count != len(names):
        raise ValueError(f"{message.count} joint positions; the arm has {len(names)} joints")
    joints = np.array(message.joints[: message.count])
    for name, value, (low, high) in zip(names, joints, ranges, strict=True):
        # The condition is negated so that NaN counts as outside.
        if not low <= value <= high:
            raise ValueError(f"joint '{name}' at {value:g} rad; permitted: {low:g} to {high:g}")
    return joints
