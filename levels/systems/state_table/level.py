"""A level whose executor is a state table: preprocess (read), decide (the table), postprocess
(write).

Plans are static: the file of a table names taught poses or steps, and no planner runs. The tables
of a level are read when its board starts, never in a cycle; an operator swaps between them at a
tick. To try an edited file, restart the board: `rack inject RACK BOARD kill`.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

from pydantic import Field as Key

from rack.backplane.message import State, field, integer
from rack.levels.level import Executor, Input, Inputs, LevelContext, Misfits, Output, Reading
from rack.levels.messages import Error
from rack.levels.operator import (
    ABOVE_LOST,
    HELD_FROM_ABOVE,
    HOLDABLE,
    AnsweringStatus,
    Commands,
    Operation,
    OperatorCommand,
    Orders,
    RelayedCommand,
    answered,
)
from rack.levels.systems.state_table.checks import flaws
from rack.levels.systems.state_table.table import (
    LATE,
    NAME_BYTES,
    PHRASE_BYTES,
    ROW_NAME_BYTES,
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
    objection,
    phrases,
    read_table,
)
from rack.levels.tables import SceneConfig, Table, read_params


class TableCommand(RelayedCommand, version=1, message="word_command"):
    """First fields of every command to a level of this kind."""

    hold: bool = field(doc="1: come to rest and stay, whatever is under way")
    words: str = field(
        f"S{PHRASE_BYTES}", doc="the command with its parameters, as in 'pick block1'"
    )


class TableStatus(AnsweringStatus, version=1):
    """First fields of the status of every level of this kind: with them a restarted board goes
    on.
    """

    table: str = field(f"S{NAME_BYTES}", doc="state table in force")
    checksum: int = integer("CRC-32 of its file")
    in_state: str = field(f"S{NAME_BYTES}", doc="state after this cycle")
    row: int = integer("row that fired in this cycle, from 1; 0: none", "u2")
    fired: str = field(f"S{ROW_NAME_BYTES}", doc="its name")
    words: str = field(f"S{PHRASE_BYTES}", doc="command in force; empty: none")
    ordered: int = integer(
        "serial of an operator's command, if it is in force; 0: it is the level above's"
    )
    done: int = integer("newest command of the level above that is done; 0: none")


YES_NO = ("no", "yes")
UNKNOWN = "unknown"
"""A command whose words the level does not know."""
BELOW = ("waiting", "executing", "done", "error", "lost")
"""Condition of the level below: waiting: it has not answered the newest command; lost: its board
is."""


class StateTableParams(Table):
    """`[board.<name>.params]`: the state tables of the level."""

    tables: dict[Name, Annotated[Path, Key(strict=False)]] = Key(min_length=1)
    """TOML files by name, relative to the config; the first is in force at the start"""


def vocabulary(
    conditions: Mapping[str, Values],
    actions: Phrases,
    commands: Phrases | None = None,
    plan: type[Table] = Table,
) -> Vocabulary:
    """Return the vocabulary of a level: its own words and, if it accepts commands, those that come
    with them.
    """
    known = {**conditions, LATE: YES_NO}
    if not commands:
        return Vocabulary(known, {}, actions, plan)
    # The newest command, of an operator or the level above; whether no row has taken it yet.
    known |= {"command": ("none", UNKNOWN, *commands), "new": YES_NO}
    return Vocabulary(known, commands, {**actions, TAKE: ()}, plan)


class WordCommand(NamedTuple):
    """A command to the level, of an operator or of the level above."""

    is_operators: bool
    serial: int  # 0: none
    words: str


OPERATIONS: Commands = {**HOLDABLE, Operation.TABLE: ()}
"""An operator's commands to every level of this kind."""


class StateTableExecutor(Executor):
    """Base of the levels: a class declares its `vocabulary`, and has `look`, and `do_<action>` for
    each action.
    """

    commands: ClassVar[Commands] = {**OPERATIONS, Operation.DO: ()}
    above = Inputs(TableCommand, "above.command", optional=True)
    last_status = Input(TableStatus, "own.status")
    operator = Input(OperatorCommand, "own.operator")
    status = Output(TableStatus)
    command: RelayedCommand
    """What it tells the level below, if there is one."""
    params = StateTableParams
    vocabulary: ClassVar[Vocabulary]

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        params = read_params(StateTableParams, context.params)
        self.tables = {name: self.read(path, context.scene) for name, path in params.tables.items()}
        if found := [f"{name}: {why}" for name, why in self._unlike(self.tables, context.scene)]:
            raise TableError(found)
        self.state = ""  # of the table
        self._since: int | None = None  # tick at which it began; None: in this cycle
        self.use(next(iter(self.tables)))
        self.orders = Orders(self.commands)
        self.detail = ""  # why, from below: added to the reason of a row
        self.resting = True  # nothing moves on this level's behalf
        self._newest = WordCommand(False, 0, "")
        self._taken = self._newest  # the one in force
        self._done = 0  # newest command of the level above that is done
        self._kept = ""  # why this level, or the one above, is held; empty: it is not
        # Newest command of an operator that the last status before a restart had answered.
        self._recalled = 0
        self._started = False

    @classmethod
    def read(cls, path: Path, scene: SceneConfig) -> StateTable:
        """Return the table in a file. Raises `TableError` with every mistake in it."""
        table = read_table(path, cls.vocabulary)
        lexicon = None if table.plan is None else cls.lexicon(scene, table.plan)
        found = flaws(table, cls.vocabulary, lexicon)
        if table.plan is not None:
            found += cls.plan_flaws(scene, table.plan)
        if found:
            raise TableError(found)
        return table

    @classmethod
    def lexicon(cls, scene: SceneConfig, plan: Any) -> Lexicon:
        """Return the sets of words that depend on the scene, and on a table's plan, by name."""
        return {"object": scene.objects}

    @classmethod
    def plan_flaws(cls, scene: SceneConfig, plan: Any) -> list[str]:
        """Return what does not suit the scene in a plan, a line each."""
        return []

    @classmethod
    def misfits(
        cls, context: LevelContext, above: Sequence[LevelContext], below: Sequence[LevelContext]
    ) -> Misfits:
        """Yield every mistake in every table, and commands that one of them does not know."""
        files = read_params(StateTableParams, context.params).tables
        tables = {}
        for name, path in files.items():
            try:
                tables[name] = cls.read(path, context.scene)
            except TableError as error:
                for flaw in error.flaws:
                    yield f"params.tables.{name}", path.name, flaw
        for name, why in cls._unlike(tables, context.scene):
            yield f"params.tables.{name}", files[name].name, why

    @classmethod
    def _unlike(
        cls, tables: Mapping[str, StateTable], scene: SceneConfig
    ) -> Iterator[tuple[str, str]]:
        """Yield tables that do not know a command that another one does, and why: the one in force
        outlives a swap.
        """
        known = {name: cls._known(scene, table) for name, table in tables.items()}
        for name, mine in known.items():
            lacking = {
                phrase: other
                for other, theirs in known.items()
                for phrase in theirs
                if phrase not in mine
            }
            for phrase, other in lacking.items():
                yield (
                    name,
                    f"does not know '{phrase}', as '{other}' does; all tables of a level know the"
                    " same commands",
                )

    @classmethod
    def _known(cls, scene: SceneConfig, table: StateTable) -> Sequence[str]:
        return tuple(phrases(cls.vocabulary.commands, cls.lexicon(scene, table.plan)))

    @classmethod
    def wording(
        cls, what: Operation, params: Mapping[str, Any], scene: SceneConfig
    ) -> Sequence[str]:
        """Return the names of the tables, or the commands that the first one's plan permits."""
        tables = read_params(StateTableParams, params).tables
        if what is Operation.TABLE:
            return tuple(tables)
        return cls._known(scene, cls.read(next(iter(tables.values())), scene))

    def use(self, name: str) -> None:
        """Put a table in force. It goes on in the state of the same name; without one, in the state
        it starts in.
        """
        self.table_name = name
        self.table = self.tables[name]
        if self.state not in self.table.rows:
            self.state = self.table.start
            self._since = None

    def process(self, tick: int) -> None:
        """Do one cycle: read, let one row fire, write."""
        if not self._started:
            self._started = True
            self.recall()
        self._preprocess()
        values = self.look(tick)
        self._since = tick if self._since is None else self._since
        values[LATE] = YES_NO[(tick - self._since) * self.context.tick_s > self.table.patience_s]
        if self.vocabulary.commands:
            # Without the words: of one command they differ only where an edited table knows others.
            is_new = self._newest[:2] != self._taken[:2] and self._newest.serial > 0
            command = self._newest if is_new else self._taken
            values["command"] = command.words.partition(" ")[0] or "none"
            values["new"] = YES_NO[is_new]
        number, row = self.table.decide(self.state, values)
        for phrase in row.do:
            verb, *parameters = phrase.split()
            getattr(self, f"do_{verb}")(*parameters)
        if row.next not in (SAME, self.state):
            self.state = row.next
            self._since = tick
        self.give(tick)
        self._report(number, row)

    @abstractmethod
    def look(self, tick: int) -> dict[str, str]:
        """Return the value of each of the level's own conditions in this cycle."""

    def give(self, tick: int) -> None:
        """Fill what the level writes, other than the fields of `TableStatus`."""

    def do_take(self) -> None:
        """Let the newest command be the one in force."""
        self._taken = self._newest

    @property
    def words(self) -> list[str]:
        """The command in force, or the newest one if it was just taken, word by word."""
        return self._taken.words.split()

    @property
    def holds(self) -> bool:
        """Whether an operator, or the level above, holds this one; or its board is lost."""
        return bool(self._kept)

    def recall(self) -> None:
        """Continue from the last messages in the level's own mailboxes, after a restart of its
        board.
        """
        if not self.last_status.is_there:
            return
        last = self.last_status.message
        self.status.copy_from(last)
        self.state = last.in_state
        table = last.table if last.table in self.tables else self.table_name
        self.use(table)
        self._recalled = answered(last)
        self._done = last.done
        self._taken = WordCommand(last.ordered > 0, last.ordered or last.echo, last.words)

    def _preprocess(self) -> None:
        """Take up what the operator and the level above command."""
        orders = self.orders
        orders.take(self.operator, self._judge)
        self._kept = ""
        self._rests_on = orders.rests_on(0)
        above: Reading[TableCommand] | None = None
        if "above" in self.inputs:
            above = next(iter(self.above.values()), None)
        if above is not None:
            self._hear(above)
        elif orders.standing is not Operation.DO:
            self._newest = self._taken
        if orders.holds:
            self._kept = orders.keeps(self.context.board)

    def _hear(self, above: Reading[TableCommand]) -> None:
        """Take up what the level above commands, unless an operator commands instead."""
        command = above.message
        self._rests_on = self.orders.rests_on(command.operator)
        if self.orders.standing is Operation.DO:
            return
        if command.id == self._done:
            self._newest = self._taken
        elif self._newest[:2] != (False, command.id):
            words = UNKNOWN if self._objection(command.words) else command.words
            self._newest = WordCommand(False, command.id, words)
        if above.is_lost:
            self._kept = ABOVE_LOST
        elif command.hold:
            self._kept = HELD_FROM_ABOVE

    def _objection(self, words: str) -> str:
        """Return why the level does not know a command; empty: it does."""
        lexicon = self.lexicon(self.context.scene, self.table.plan)
        return objection(words, self.vocabulary.commands, lexicon)

    def _judge(self, order: OperatorCommand) -> None:
        """Take up an operator's command for this kind of level."""
        if order.what == Operation.TABLE:
            if order.name not in self.tables:
                self.orders.refuse(f"no table '{order.name}'; tables: {', '.join(self.tables)}")
            elif order.id > self._recalled:
                self.use(order.name)
        elif order.what == Operation.DO:
            if why := self._objection(order.name):
                self.orders.refuse(why)
            else:
                self._newest = WordCommand(True, order.id, order.name)

    def _report(self, number: int, row: RowConfig) -> None:
        """Fill the fields of `TableStatus`, and the operator's in the command."""
        shown = self.status
        orders = self.orders
        state = STATES[row.status]
        reason = row.reason
        if self._kept and state is State.EXECUTING:
            state = State.HOLDING
            reason = self._kept
        elif reason and self.detail:
            reason = f"{reason}: {self.detail}"
        if row.next == SAME and state is State.ERROR and shown.state == state:
            reason = shown.reason  # the first one, from below too: the row only stays with it
        is_operators, serial, words = self._taken
        shown.ordered = 0
        if is_operators:
            shown.ordered = serial
            shown.echo = 0 if orders.standing is Operation.DO else self._done
        else:
            shown.echo = serial
            if state is State.DONE:
                self._done = serial
        shown.state = state
        shown.error = Error.TABLE if state is State.ERROR else Error.NONE
        shown.reason = reason
        shown.table = self.table_name
        shown.checksum = self.table.checksum
        shown.in_state = self.state
        shown.row = number
        shown.fired = row.name
        shown.words = words
        shown.done = self._done
        is_done = self.resting if orders.holds else state is State.DONE
        if is_operators and serial == orders.in_force and state is State.ERROR:
            orders.fail(reason)
        elif is_done:
            orders.done()
        if "command" in self.outputs:
            self.command.operator = self._rests_on
        orders.report(shown, self._rests_on)


def answer_of(reading: Reading[TableStatus], serial: int) -> str:
    """Return the value of `BELOW` for a status and the serial of the newest command sent down."""
    if reading.is_lost:
        return "lost"
    if not reading.is_there or reading.message.echo != serial or not serial:
        return "waiting"
    return {State.DONE: "done", State.ERROR: "error"}.get(reading.message.state, "executing")
