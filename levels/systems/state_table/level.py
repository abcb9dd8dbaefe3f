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
from typing import Annotated, Any, ClassVar

from pydantic import Field as Key

from rack.backplane.message import Field, Message, State, command, status
from rack.levels.level import Executor, Input, LevelContext, Ports, Reading
from rack.levels.messages import Error
from rack.levels.operator import (
    ABOVE_LOST,
    ANSWER,
    HELD_FROM_ABOVE,
    OPERATOR_COMMAND,
    RESTS_ON,
    Operation,
    Orders,
)
from rack.levels.systems.state_table.checks import flaws
from rack.levels.systems.state_table.table import (
    LATE,
    ROW_NAME_BYTES,
    SAME,
    Name,
    Row,
    StateTable,
    TableError,
    read_text,
)
from rack.levels.systems.state_table.vocabulary import (
    NAME_BYTES,
    PHRASE_BYTES,
    TAKE,
    Condition,
    Lexicon,
    Phrase,
    Vocabulary,
    objection,
    phrases,
)
from rack.levels.tables import SceneConfig, Table, read_params

COMMAND_HEAD = (
    RESTS_ON,
    Field("hold", "u1", "1", "1: come to rest and stay, whatever is under way"),
    Field(
        "words", f"S{PHRASE_BYTES}", "ASCII", "the command with its parameters, as in 'pick block1'"
    ),
)
"""First fields of every command to a level of this kind."""
STATUS_HEAD = (
    *ANSWER,
    Field("table", f"S{NAME_BYTES}", "ASCII", "state table in force"),
    Field("checksum", "u4", "1", "CRC-32 of its file"),
    Field("in_state", f"S{NAME_BYTES}", "ASCII", "state after this cycle"),
    Field("row", "u2", "1", "row that fired in this cycle, from 1; 0: none"),
    Field("fired", f"S{ROW_NAME_BYTES}", "ASCII", "its name"),
    Field("words", f"S{PHRASE_BYTES}", "ASCII", "command in force; empty: none"),
    Field(
        "ordered",
        "u4",
        "1",
        "serial of an operator's command, if it is in force; 0: it is the level above's",
    ),
    Field("done", "u4", "1", "newest command of the level above that is done; 0: none"),
)
"""First fields of the status of every level of this kind: with them a restarted board goes on."""
WORD_COMMAND = command("word_command", 1, *COMMAND_HEAD)
TABLE_STATUS = status("table_status", 1, *STATUS_HEAD)
YES_NO = ("no", "yes")
UNKNOWN = "unknown"
BELOW = Condition(
    ("waiting", "executing", "done", "error", "lost"),
    "the level below: waiting: it has not answered the newest command; lost: its board is",
)


class StateTableParams(Table):
    """`[board.<name>.params]`: the state tables of the level."""

    tables: dict[Name, Annotated[Path, Key(strict=False)]] = Key(
        min_length=1,
        description=(
            "TOML files by name, relative to the config; the first is in force at the start"
        ),
    )


def vocabulary(
    conditions: Mapping[str, Condition],
    actions: Mapping[str, Phrase],
    commands: Mapping[str, Phrase] | None = None,
    plan: type[Table] | None = None,
) -> Vocabulary:
    """Return the vocabulary of a level: its own words and, if it accepts commands, those that come
    with them."""
    late = Condition(YES_NO, "whether the state has lasted longer than the table's patience")
    found = {**conditions, LATE: late}
    acts = dict(actions)
    if commands:
        found["command"] = Condition(
            ("none", UNKNOWN, *commands),
            f"the newest command, of an operator or the level above; {UNKNOWN}: the level does not"
            " know its words",
        )
        found["new"] = Condition(
            YES_NO, f"whether no row has done '{TAKE}' since that command came"
        )
        acts[TAKE] = Phrase(
            (), "let the newest command be the one in force: the status answers it from now on"
        )
    return Vocabulary(found, commands or {}, acts, *([plan] if plan is not None else []))


class StateTableExecutor(Executor):
    """Base of the levels: a class declares its `vocabulary`, and has `look`, and `do_<action>` for
    each action."""

    commands = {
        Operation.HOLD: (),
        Operation.RESUME: (),
        Operation.TABLE: (),
        Operation.DO: (),
    }
    inputs = {
        "command": Input(WORD_COMMAND, "above.command", many=True, optional=True),
        "last_status": Input(TABLE_STATUS, "own.status"),
        "operator": Input(OPERATOR_COMMAND, "own.operator"),
    }
    outputs = {"status": TABLE_STATUS}
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
        self._words = ""  # command in force
        self._taken: tuple[bool, int] = (False, 0)  # whether it is an operator's, and its serial
        self._done = 0  # newest command of the level above that is done
        self._newest: tuple[bool, int, str] = (
            False,
            0,
            "",
        )  # the newest command likewise, and its words
        self._kept = ""  # why this level, or the one above, is held; empty: it is not
        self._recalled = (
            0  # newest command of an operator that the last status before a restart had answered
        )
        self._started = False

    @classmethod
    def read(cls, path: Path, scene: SceneConfig) -> StateTable:
        """Return the table in a file. Raises `TableError` with every mistake in it."""
        text = read_text(path, cls.vocabulary)
        lexicon = None if text.plan is None else cls.lexicon(scene, text.plan)
        found = flaws(text, cls.vocabulary, lexicon)
        if text.plan is not None:
            found += cls.plan_flaws(scene, text.plan)
        if found:
            raise TableError(found)
        return text.table()

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
    ) -> Iterator[tuple[str, Any, str]]:
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
        outlives a swap."""
        known = {
            name: [*phrases(cls.vocabulary.commands, cls.lexicon(scene, t.plan))]
            for name, t in tables.items()
        }
        for name in tables:
            lacking = {
                phrase: other
                for other in tables
                for phrase in known[other]
                if phrase not in known[name]
            }
            for phrase, other in lacking.items():
                yield (
                    name,
                    (
                        f"does not know '{phrase}', as '{other}' does; all tables of a level know"
                        " the same commands"
                    ),
                )

    @classmethod
    def wording(
        cls, what: Operation, params: Mapping[str, Any], scene: SceneConfig
    ) -> Sequence[str]:
        """Return the names of the tables, or the commands that the first one's plan permits."""
        tables = read_params(StateTableParams, params).tables
        if what is Operation.TABLE:
            return tuple(tables)
        plan = cls.read(next(iter(tables.values())), scene).plan
        return tuple(phrases(cls.vocabulary.commands, cls.lexicon(scene, plan)))

    def use(self, name: str) -> None:
        """Put a table in force. It goes on in the state of the same name; without one, in the state
        it starts in."""
        self.table_name = name
        self.table = self.tables[name]
        if self.state not in self.table.rows:
            self.state = self.table.start
            self._since = None

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Do one cycle: read, let one row fire, write."""
        if not self._started:
            self._started = True
            self.recall(read, write)
        self._preprocess(read)
        values = self.look(read, tick)
        self._since = tick if self._since is None else self._since
        values[LATE] = YES_NO[(tick - self._since) * self.context.tick_s > self.table.patience_s]
        if self.vocabulary.commands:
            is_new = self._newest[:2] != self._taken and self._newest[1] > 0
            words = self._newest[2] if is_new else self._words
            values["command"] = words.partition(" ")[0] or "none"
            values["new"] = YES_NO[is_new]
        row = self.table.decide(self.state, values)
        if row is not None:
            for verb, *parameters in row.do:
                getattr(self, f"do_{verb}")(*parameters)
            if row.next not in (SAME, self.state):
                self.state = row.next
                self._since = tick
        self.give(write, tick)
        self._report(write, row, values)

    @abstractmethod
    def look(self, read: Ports, tick: int) -> dict[str, str]:
        """Return the value of each of the level's own conditions in this cycle."""

    def give(self, write: Ports, tick: int) -> None:
        """Fill what the level writes, other than the fields of `STATUS_HEAD`."""

    def do_take(self) -> None:
        """Let the newest command be the one in force."""
        is_operators, serial, self._words = self._newest
        self._taken = is_operators, serial

    @property
    def words(self) -> list[str]:
        """The command in force, or the newest one if it was just taken, word by word."""
        return self._words.split()

    @property
    def holds(self) -> bool:
        """Whether an operator, or the level above, holds this one; or its board is lost."""
        return bool(self._kept)

    def recall(self, read: Ports, write: Ports) -> None:
        """Continue from the last messages in the level's own mailboxes, after a restart of its
        board."""
        if not read.last_status.is_there:
            return
        last = read.last_status.value
        write.status.copy_from(last)
        self.state = last.in_state
        self.use(last.table if last.table in self.tables else self.table_name)
        self._recalled = last.order
        self._words = last.words
        self._done = last.done
        self._taken = (True, last.ordered) if last.ordered else (False, last.echo)

    def _preprocess(self, read: Ports) -> None:
        self.orders.take(read.operator, self._judge)
        above: Reading | None = (
            next(iter(read.command.values()), None) if "command" in self.inputs else None
        )
        ordered = self.orders.standing is Operation.DO
        if not ordered and above is not None and above.value.id != self._done:
            self._newest = False, above.value.id, self._understood(above.value)
        elif not ordered:
            self._newest = (*self._taken, self._words)
        self._kept = ""
        if self.orders.standing is Operation.HOLD:
            self._kept = self.orders.keeps(self.context.board)
        elif above is not None and not ordered:
            self._kept = (
                ABOVE_LOST if above.is_lost else HELD_FROM_ABOVE if above.value.hold else ""
            )
        self._rests_on = self.orders.rests_on(above.value.operator if above is not None else 0)

    def _understood(self, command: Message) -> str:
        """Return the words of a command from above; `UNKNOWN` if the level does not know them."""
        serial, words = self._newest[1:]
        if command.id == serial and not self._newest[0]:
            return words
        lexicon = self.lexicon(self.context.scene, self.table.plan)
        return (
            UNKNOWN
            if objection(command.words, self.vocabulary.commands, lexicon)
            else command.words
        )

    def _judge(self, order: Message) -> None:
        """Take up an operator's command for this kind of level."""
        if order.what == Operation.TABLE:
            if order.name not in self.tables:
                self.orders.refuse(f"no table '{order.name}'; tables: {', '.join(self.tables)}")
            elif order.id > self._recalled:
                self.use(order.name)
        elif order.what == Operation.DO:
            lexicon = self.lexicon(self.context.scene, self.table.plan)
            if why := objection(order.name, self.vocabulary.commands, lexicon):
                self.orders.refuse(why)
            else:
                self._newest = True, order.id, order.name

    def _report(self, write: Ports, row: Row | None, values: Mapping[str, str]) -> None:
        """Fill the fields of `STATUS_HEAD`, and the operator's in the command."""
        shown: Message = write.status
        state, reason = (
            (row.status, row.reason) if row is not None else (State.ERROR, self._no_row(values))
        )
        if self._kept and state is State.EXECUTING:
            state = State.HOLDING
            reason = self._kept
        elif reason and self.detail:
            reason = f"{reason}: {self.detail}"
        if row is not None and row.next == SAME and state is State.ERROR and shown.state == state:
            reason = shown.reason  # the first one, from below too: the row only stays with it
        is_operators, serial = self._taken
        if state is State.DONE and not is_operators:
            self._done = serial
        shown.state = state
        shown.error = Error.TABLE if state is State.ERROR else Error.NONE
        shown.reason = reason
        shown.echo = (
            serial
            if not is_operators
            else 0
            if self.orders.standing is Operation.DO
            else self._done
        )
        shown.table = self.table_name
        shown.checksum = self.table.checksum
        shown.in_state = self.state
        shown.row, shown.fired = (row.number, row.name) if row is not None else (0, "")
        shown.words = self._words
        shown.ordered = serial * is_operators
        shown.done = self._done
        if is_operators and serial == self.orders.serial and state is State.ERROR:
            self.orders.fail(reason)
        elif self.resting if self.orders.standing is Operation.HOLD else state is State.DONE:
            self.orders.done()
        if "command" in write.__dict__:
            write.command.operator = self._rests_on
        self.orders.report(shown, self._rests_on)

    def _no_row(self, values: Mapping[str, str]) -> str:
        case = ", ".join(f"{name} = {value}" for name, value in values.items())
        return f"no row of '{self.state}' takes {case}"


def answer_of(reading: Reading, serial: int) -> str:
    """Return the value of `BELOW` for a status and the serial of the newest command sent down."""
    if reading.is_lost:
        return "lost"
    if not reading.is_there or reading.value.echo != serial or not serial:
        return "waiting"
    return {State.DONE: "done", State.ERROR: "error"}.get(reading.value.state, "executing")
