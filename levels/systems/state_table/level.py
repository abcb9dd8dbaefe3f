"""A level whose executor is a state table.

A cycle preprocesses its inputs (read), decides by the table, and postprocesses (write). Plans are
static: the file of a table contains taught poses or steps, and no planner runs. The tables of a
level are read when its board starts, never in a cycle. An operator can switch between them at a
tick. To try an edited file, restart the board: `rack inject RACK BOARD kill`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

from pydantic import Field as Key

from rack.backplane.message import State, field, integer_field
from rack.levels.level import (
    OPERATOR,
    Executor,
    Input,
    Inputs,
    LevelContext,
    Mismatches,
    Output,
    Reading,
)
from rack.levels.messages import Error
from rack.levels.operator import (
    ABOVE_LOST,
    HELD_FROM_ABOVE,
    HOLD_COMMANDS,
    AnsweringStatus,
    Commands,
    Operation,
    OperatorCommand,
    RelayedCommand,
    find_answered_serial,
)
from rack.levels.systems.state_table.checks import find_flaws
from rack.levels.systems.state_table.table import (
    LATE,
    MAX_NAME_BYTES,
    MAX_PHRASE_BYTES,
    MAX_ROW_NAME_BYTES,
    SAME,
    STATES,
    TAKE,
    Lexicon,
    Name,
    Phrases,
    RowConfig,
    StateTable,
    TableError,
    Values,
    Vocabulary,
    find_phrase_error,
    list_phrases,
    read_table,
)
from rack.levels.tables import SceneConfig, Table, read_params


class TableCommand(RelayedCommand, version=1, message="word_command"):
    """Fields with which every command to a level of this kind begins."""

    hold: bool = field(doc="1: come to rest and stay, whatever is under way")
    words: str = field(
        f"S{MAX_PHRASE_BYTES}", doc="the command with its parameters, as in 'pick block1'"
    )


class TableStatus(AnsweringStatus, version=1):
    """Fields with which the status of every level of this kind begins.

    A restarted board continues from them.
    """

    table: str = field(f"S{MAX_NAME_BYTES}", doc="state table in force")
    checksum: int = integer_field("CRC-32 of its file")
    in_state: str = field(f"S{MAX_NAME_BYTES}", doc="state after this cycle")
    row: int = integer_field("row that fired in this cycle, counted from 1 (0: none)", "u2")
    fired: str = field(f"S{MAX_ROW_NAME_BYTES}", doc="its name")
    words: str = field(f"S{MAX_PHRASE_BYTES}", doc="command in force (empty: none)")
    ordered: int = integer_field(
        "serial of the operator's command in force (0: the level above commands)"
    )
    done: int = integer_field("newest completed command of the level above (0: none)")


YES_NO = ("no", "yes")
UNKNOWN = "unknown"
"""Value of the condition `command` for a command that the level does not accept."""
BELOW = ("waiting", "executing", "done", "error", "lost")
"""Values of the condition `below`, the answer of the level below.

It is waiting until it has answered the newest command, and lost if its board is lost.
"""


class StateTableParams(Table):
    """`[board.<name>.params]`: the state tables of the level."""

    tables: dict[Name, Annotated[Path, Key(strict=False)]] = Key(min_length=1)
    """TOML files by name, relative to the config; the first is in force at the start"""


def build_vocabulary(
    conditions: Mapping[str, Values],
    actions: Phrases,
    commands: Phrases | None = None,
    plan: type[Table] = Table,
) -> Vocabulary:
    """Build the vocabulary of a level.

    Args:
        conditions: Possible values of each of the level's own conditions.
        actions: The level's own actions.
        commands: Commands that the level accepts, or None. If there are any, the conditions
            `command` and `new` and the action `take` are added.
        plan: Record class of the static plan.
    """
    all_conditions = {**conditions, LATE: YES_NO}
    if not commands:
        return Vocabulary(all_conditions, {}, actions, plan)
    # `command` is the newest command, from an operator or the level above. `new` tells whether
    # a row still has to take it.
    all_conditions |= {"command": ("none", UNKNOWN, *commands), "new": YES_NO}
    return Vocabulary(all_conditions, commands, {**actions, TAKE: ()}, plan)


class WordCommand(NamedTuple):
    """A command to the level, from an operator or from the level above."""

    is_from_operator: bool
    serial: int  # 0 if there is no command
    words: str


OPERATIONS: Commands = {**HOLD_COMMANDS, Operation.TABLE: ()}
"""Operator commands that every level of this kind obeys."""


class StateTableExecutor(Executor):
    """Base class of levels that are programmed by a state table.

    A subclass declares its `vocabulary` and implements `evaluate_conditions`, and `do_<action>` for
    each of its actions. The current command is the one that a row took last (action `take`).
    """

    commands: ClassVar[Commands] = {**OPERATIONS, Operation.DO: ()}
    above = Inputs(TableCommand, "above.command", optional=True)
    last_status = Input(TableStatus, "own.status")
    operator = OPERATOR
    status = Output(TableStatus)
    command: RelayedCommand
    """Command to the level below, if there is one."""
    params = StateTableParams
    settings: StateTableParams
    vocabulary: ClassVar[Vocabulary]

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.tables = {
            name: self.read(path, context.scene) for name, path in self.settings.tables.items()
        }
        if flaws := [
            f"{name}: {flaw}"
            for name, flaw in self._find_unequal_commands(self.tables, context.scene)
        ]:
            raise TableError(flaws)
        self.state = ""  # of the table
        # Tick at which the state began. None if it begins in this cycle.
        self._state_since_tick: int | None = None
        self.use_table(next(iter(self.tables)))
        self.detail = ""  # reason given by the level below, appended to a row's reason
        self.resting = True  # no motion commanded by this level is under way
        self._newest = WordCommand(False, 0, "")
        self._taken = self._newest  # current command
        self._done_serial = 0  # newest completed command of the level above
        self._hold_reason = ""  # why this level, or the one above, is held; empty if it is not
        # Newest operator command that was answered before the board was restarted.
        self._answered_before_restart = 0
        self._started = False

    @classmethod
    def read(cls, path: Path, scene: SceneConfig) -> StateTable:
        """Read and check the table in a file. Raises `TableError` with every mistake in it."""
        table = read_table(path, cls.vocabulary)
        lexicon = None if table.plan is None else cls.build_lexicon(scene, table.plan)
        lines = find_flaws(table, cls.vocabulary, lexicon)
        if table.plan is not None:
            lines += cls.find_plan_flaws(scene, table.plan)
        if lines:
            raise TableError(lines)
        return table

    @classmethod
    def build_lexicon(cls, scene: SceneConfig, plan: Any) -> Lexicon:
        """Return the sets of words that depend on the scene and a table's plan, keyed by name."""
        return {"object": scene.objects}

    @classmethod
    def find_plan_flaws(cls, scene: SceneConfig, plan: Any) -> list[str]:
        """Return one line for every entry of a plan that does not match the scene."""
        return []

    @classmethod
    def find_mismatches(cls, context: LevelContext) -> Mismatches:
        """Yield every mistake in the tables, and the commands that only some of them accept."""
        files = read_params(StateTableParams, context.params).tables
        tables = {}
        for name, path in files.items():
            try:
                tables[name] = cls.read(path, context.scene)
            except TableError as error:
                for flaw in error.flaws:
                    yield f"params.tables.{name}", path.name, flaw
        for name, why in cls._find_unequal_commands(tables, context.scene):
            yield f"params.tables.{name}", files[name].name, why

    @classmethod
    def _find_unequal_commands(
        cls, tables: Mapping[str, StateTable], scene: SceneConfig
    ) -> Iterator[tuple[str, str]]:
        """Yield the name of each table that lacks a command of another one, and the reason.

        All tables must accept the same commands, because a switch between them does not change the
        current command.
        """
        commands = {name: cls._list_commands(scene, table) for name, table in tables.items()}
        for name, own_commands in commands.items():
            missing = {
                phrase: other
                for other, other_commands in commands.items()
                for phrase in other_commands
                if phrase not in own_commands
            }
            for phrase, other in missing.items():
                yield (
                    name,
                    f"does not know '{phrase}', as '{other}' does; all tables of a level know the"
                    " same commands",
                )

    @classmethod
    def _list_commands(cls, scene: SceneConfig, table: StateTable) -> Sequence[str]:
        """Return every command that a table accepts, with its parameters."""
        return tuple(list_phrases(cls.vocabulary.commands, cls.build_lexicon(scene, table.plan)))

    @classmethod
    def list_operation_names(
        cls, what: Operation, params: Mapping[str, Any], scene: SceneConfig
    ) -> Sequence[str]:
        """Return the words that an operator may give with an operation.

        Args:
            what: Operation to complete.
            params: Parameters of the level, which name its tables.
            scene: Scene of the rack.

        Returns:
            Names of the tables for `Operation.TABLE`. Otherwise the commands that the plan of the
            first table permits.
        """
        tables = read_params(StateTableParams, params).tables
        if what is Operation.TABLE:
            return tuple(tables)
        return cls._list_commands(scene, cls.read(next(iter(tables.values())), scene))

    def use_table(self, name: str) -> None:
        """Switch to a table.

        The level continues in the state of the same name if the table has one, else in the start
        state.
        """
        self.table_name = name
        self.table = self.tables[name]
        if self.state not in self.table.rows:
            self.state = self.table.start
            self._state_since_tick = None

    def process(self, tick: int) -> None:
        """Run one cycle: read the inputs, execute the row that fires, and write the outputs."""
        if not self._started:
            self._started = True
            self.restore_state()
        self._take_commands()
        values = self.evaluate_conditions(tick)
        self._state_since_tick = tick if self._state_since_tick is None else self._state_since_tick
        values[LATE] = YES_NO[
            (tick - self._state_since_tick) * self.context.tick_s > self.table.patience_s
        ]
        if self.vocabulary.commands:
            # Compare sender and serial, not the words, because an edited table may have other words
            # for the same command.
            is_new = self._newest[:2] != self._taken[:2] and self._newest.serial > 0
            command = self._newest if is_new else self._taken
            values["command"] = command.words.partition(" ")[0] or "none"
            values["new"] = YES_NO[is_new]
        number, row = self.table.choose_row(self.state, values)
        for phrase in row.do:
            verb, *parameters = phrase.split()
            getattr(self, f"do_{verb}")(*parameters)
        if row.next not in (SAME, self.state):
            self.state = row.next
            self._state_since_tick = tick
        self.write_outputs(tick)
        self._write_status(number, row)

    @abstractmethod
    def evaluate_conditions(self, tick: int) -> dict[str, str]:
        """Return the value of each of the level's own conditions in this cycle."""

    def write_outputs(self, tick: int) -> None:
        """Write the outputs of the level, except the fields of `TableStatus`."""

    def do_take(self) -> None:
        """Make the newest command the current one."""
        self._taken = self._newest

    @property
    def words(self) -> list[str]:
        """Words of the current command."""
        return self._taken.words.split()

    @property
    def is_held(self) -> bool:
        """Whether an operator or the level above holds the level, or the level above is lost."""
        return bool(self._hold_reason)

    def restore_state(self) -> None:
        """Continue from the level's own last messages after a restart of its board."""
        if not self.last_status.has_message:
            return
        last = self.last_status.message
        self.status.copy_from(last)
        self.state = last.in_state
        self.use_table(last.table if last.table in self.tables else self.table_name)
        self._answered_before_restart = find_answered_serial(last)
        self._done_serial = last.done
        self._taken = WordCommand(last.ordered > 0, last.ordered or last.echo, last.words)

    def _take_commands(self) -> None:
        """Read the commands of operator and level above, and update the reason for holding."""
        orders = self._orders
        orders.take_commands(self.operator, self._accept_operator_command)
        self._hold_reason = ""
        self._rests_on = orders.find_basis(0)
        above: Reading[TableCommand] | None = None
        if "above" in self.inputs:
            above = next(iter(self.above.values()), None)
        if above is not None:
            self._take_command_from_above(above)
        elif orders.standing is not Operation.DO:
            self._newest = self._taken
        if orders.is_holding:
            self._hold_reason = orders.format_reason(self.context.board)

    def _take_command_from_above(self, above: Reading[TableCommand]) -> None:
        """Take the command of the level above, unless an operator commands the level."""
        command = above.message
        self._rests_on = self._orders.find_basis(command.operator)
        if self._orders.standing is Operation.DO:
            return
        if command.id == self._done_serial:
            self._newest = self._taken
        elif self._newest[:2] != (False, command.id):
            words = UNKNOWN if self._find_command_error(command.words) else command.words
            self._newest = WordCommand(False, command.id, words)
        if above.is_lost:
            self._hold_reason = ABOVE_LOST
        elif command.hold:
            self._hold_reason = HELD_FROM_ABOVE

    def _find_command_error(self, words: str) -> str:
        """Return why a command is invalid, or an empty string if it is valid."""
        lexicon = self.build_lexicon(self.context.scene, self.table.plan)
        return find_phrase_error(words, self.vocabulary.commands, lexicon)

    def _accept_operator_command(self, order: OperatorCommand) -> None:
        """Execute or refuse a TABLE or DO command of an operator."""
        if order.what == Operation.TABLE:
            if order.name not in self.tables:
                self._orders.refuse_newest(
                    f"no table '{order.name}'; tables: {', '.join(self.tables)}"
                )
            elif order.id > self._answered_before_restart:
                self.use_table(order.name)
        elif order.what == Operation.DO:
            if why := self._find_command_error(order.name):
                self._orders.refuse_newest(why)
            else:
                self._newest = WordCommand(True, order.id, order.name)

    def _write_status(self, number: int, row: RowConfig) -> None:
        """Fill the fields of `TableStatus`, and the operator's serial in the command sent down.

        Args:
            number: Number of the row that fired.
            row: The row that fired.
        """
        status = self.status
        orders = self._orders
        state = STATES[row.status]
        reason = row.reason
        if self._hold_reason and state is State.EXECUTING:
            state = State.HOLDING
            reason = self._hold_reason
        elif reason and self.detail:
            reason = f"{reason}: {self.detail}"
        if row.next == SAME and state is State.ERROR and status.state == state:
            # While a row stays in an error, keep the first reason with its detail from below.
            reason = status.reason
        is_operators, serial, words = self._taken
        status.ordered = 0
        if is_operators:
            status.ordered = serial
            status.echo = 0 if orders.standing is Operation.DO else self._done_serial
        else:
            status.echo = serial
            if state is State.DONE:
                self._done_serial = serial
        status.state = state
        status.error = Error.TABLE if state is State.ERROR else Error.NONE
        status.reason = reason
        status.table = self.table_name
        status.checksum = self.table.checksum
        status.in_state = self.state
        status.row = number
        status.fired = row.name
        status.words = words
        status.done = self._done_serial
        is_done = self.resting if orders.is_holding else state is State.DONE
        if is_operators and serial == orders.in_force and state is State.ERROR:
            orders.abandon_command(reason)
        elif is_done:
            orders.report_done()
        if "command" in self.outputs:
            self.command.operator = self._rests_on
        orders.fill_status(status, self._rests_on)


def classify_answer(reading: Reading[TableStatus], serial: int) -> str:
    """Return the value of the condition `below`, one of `BELOW`.

    Args:
        reading: Status of the level below.
        serial: Serial of the newest command sent down.
    """
    if reading.is_lost:
        return "lost"
    if not reading.has_message or reading.message.echo != serial or not serial:
        return "waiting"
    return {State.DONE: "done", State.ERROR: "error"}.get(reading.message.state, "executing")
