"""Why two runs diverge, as far as their recordings say: from a message that differs back to its
cause.

Messages become visible at ticks, so the recording has all that a task had read at a release: what
was visible until then. While some of that differs, the way goes back to who wrote it, and to an
earlier cycle. It ends at a task whose inputs were equal: what befell that task (a fault, its death,
a cycle missed) or its config differs, or else its code, or what its level remembers. The last two
are in no recording: see `rack.tools.report.cycle_again`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np

from rack.backplane.address_map import CLOCK
from rack.backplane.bounded_toml import load_toml
from rack.backplane.fault_table import NEVER
from rack.backplane.layout import MailboxSpec, TaskSpec
from rack.boards.config.schema import LAN
from rack.tools.recording.divergence import UnlikeMessage, common_ticks, row_of, unlike_messages
from rack.tools.recording.history import misses
from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import Signal, mailbox_of, signals_of

ClueKind = Literal["fault", "died", "command", "demand", "late", "skipped", "config", "outside"]
EVENTS: Mapping[str | None, ClueKind] = {
    "fault": "fault",
    "died": "died",
    "command": "command",
    "demand": "demand",
}
"""Kinds of clues by the kinds of events, or a code, that are no consequence of messages."""
MISSED = {"late": "'{}' missed its deadline", "skipped": "'{}' skipped this cycle"}
OWN = ("name", "record.", "clock.mode", "clock.speed", "fault", "command", "python_path")
"""Keys of a config that no level's messages depend on, and those whose effects are events."""


@dataclass(frozen=True)
class InBoth:
    """A value that differs: in the run, and in the other one; None where there is none."""

    name: str
    here: Any
    there: Any


@dataclass(frozen=True)
class Clue:
    """What may be the cause: of `run` alone, or of both where that is empty; `tick` -1: from the
    beginning.
    """

    kind: ClueKind
    text: str
    run: str = ""
    tick: int = -1
    values: InBoth | None = None


class Told(NamedTuple):
    """An event as a clue; `key` is equal for what happened alike in both runs, `about` names the
    boards, tasks and mailboxes that it concerns.
    """

    key: tuple[str, ...]
    about: tuple[str, ...]
    clue: Clue


@dataclass(frozen=True)
class UnlikeCycle:
    """The cycle in which a task wrote the first message of a mailbox that differs.

    `fields` are those that differ in it. Of the mailboxes that the task had `read`, either all were
    equal until then, or one was `unequal`: the next step back.
    """

    tick: int
    mailbox: str
    writer: str
    fields: tuple[InBoth, ...]
    read: tuple[str, ...]
    unequal: str
    clues: tuple[Clue, ...]


class Divergence:
    """Two runs that diverge, or do not; `unlike` are the first messages that differ, by mailbox,
    the earliest first. Raises `Failure` as `unlike_messages` does.
    """

    def __init__(self, one: Recording, other: Recording) -> None:
        self.runs = one, other
        self.unlike = {unlike.mailbox: unlike for unlike in unlike_messages(one, other)}
        self._begin, _ = common_ticks(one, other)

    def chain(self, mailbox: str = "") -> tuple[UnlikeCycle, ...]:
        """Return the cycles from the first message that differs, of all or of this mailbox, back to
        the cause. Raises `Failure` for a mailbox that does not exist.
        """
        if mailbox:
            mailbox_of(mailbox, self.runs[0].layout.timed)
        name = mailbox or next(iter(self.unlike), "")
        found: dict[str, UnlikeCycle] = {}
        # Messages that are visible at once may lead in a circle, within a tick.
        while name in self.unlike and name not in found:
            found[name] = self._cycle(self.unlike[name])
            name = found[name].unequal
        return tuple(found.values())

    def _cycle(self, unlike: UnlikeMessage) -> UnlikeCycle:
        layout = self.runs[0].layout
        box = layout.mailbox(unlike.mailbox)
        read = [source for source in layout.timed if box.writer in source.readers]
        unequal = [source.name for source in read if self._was_unequal(source, box.writer, unlike)]
        first = min(unequal, key=lambda name: self.unlike[name].tick, default="")
        clues = [*self._events(box, unlike)]
        if box.writer != CLOCK:
            clues += self._missed(layout.task(box.writer), unlike.tick)
        if not first and box.writer != CLOCK:
            clues += [*self._config(box.writer), *self._outside(box.writer)]
        return UnlikeCycle(
            tick=unlike.tick,
            mailbox=box.name,
            writer=box.writer,
            fields=tuple(self._fields(box, unlike.serial)),
            read=tuple(source.name for source in read),
            unequal=first,
            clues=tuple(clues),
        )

    def _was_unequal(self, source: MailboxSpec, reader: str, unlike: UnlikeMessage) -> bool:
        """Say whether a task had read otherwise in a mailbox, until the cycle in which it wrote
        otherwise.
        """
        found = self.unlike.get(source.name)
        grid = self.runs[0].layout.read_grid(source, reader)
        at = unlike.tick - (unlike.tick - grid.phase) % grid.every
        return found is not None and found.visible_at <= at and found.mailbox != unlike.mailbox

    def _fields(self, box: MailboxSpec, serial: int) -> Iterator[InBoth]:
        """Yield what differs in a message."""
        here, there = (row_of(run, box, serial) for run in self.runs)
        ticks = (None if row is None else int(row["tick"]) for row in (here, there))
        if here is None or there is None or here["tick"] != there["tick"]:
            # These are messages of different cycles.
            yield InBoth("tick", *ticks)
            return
        if here["visible_at"] != there["visible_at"]:
            yield InBoth("visible_at", int(here["visible_at"]), int(there["visible_at"]))
        for signal in signals_of(box):
            yield from _unlike_signal(signal, here["message"][None], there["message"][None])
        if here["basis"] != there["basis"]:
            yield InBoth("basis", int(here["basis"]), int(there["basis"]))

    def _events(self, box: MailboxSpec, unlike: UnlikeMessage) -> Iterator[Clue]:
        """Yield what befell the writer of a message, or the whole rack, in one of the runs only."""
        boards = {name.partition(".")[0] for name in (box.writer, box.name)}
        about = {CLOCK, box.writer, box.name, *boards}
        found = [list(self._told(run)) for run in self.runs]
        for own, others, run in zip(found, reversed(found), self.runs, strict=True):
            row = row_of(run, box, unlike.serial)
            # A death is noticed when its messages are missing already, and perhaps none follows.
            written = NEVER if row is None else int(row["tick"])
            known = Counter(told.key for told in others)
            for told in own:
                # A level reads commands as messages of the clock.
                if told.clue.kind == "command" and box.writer != CLOCK:
                    continue
                known[told.key] -= 1
                until = written if told.clue.kind == "died" else unlike.tick
                if known[told.key] < 0 and about & {*told.about} and told.clue.tick <= until:
                    yield told.clue

    def _told(self, run: Recording) -> Iterator[Told]:
        """Yield what was done to a run, and the deaths in it, as its events say."""
        for event in run.events:
            kind = EVENTS.get(event.get("code")) or EVENTS.get(event["kind"])
            if kind is not None and event["tick"] >= self._begin:
                about = event["board"], event["subject"]
                # The text of a death has the number of a process.
                text = "" if kind == "died" else f"{event['tick']} {event['text']}"
                clue = Clue(kind, event["text"], str(run.folder), event["tick"])
                yield Told((kind, *about, text), about, clue)

    def _missed(self, task: TaskSpec, tick: int) -> Iterator[Clue]:
        """Yield that a task was late with the cycle of this tick, or left it out, in one run."""
        found = [
            Clue(miss["what"], MISSED[miss["what"]].format(task.name), str(run.folder), tick)
            for run in self.runs
            for miss in misses(run)
            if miss["task"] == task.name
            and miss["tick"] <= tick < miss["tick"] + miss["count"] * task.every
        ]
        if len({clue.run for clue in found}) == 1:
            yield from found

    def _config(self, task: str) -> Iterator[Clue]:
        """Yield the keys of the writer's board that differ; if none does, those of the rack."""
        tables = (load_toml(run.config) for run in self.runs)
        differ = [both for both in unlike_values(*tables) if not both.name.startswith(OWN)]
        board = f"board.{task.partition('.')[0]}."
        own = [both for both in differ if both.name.startswith(board)]
        for both in own or differ:
            yield Clue("config", f"{both.name} differs", values=both)

    def _outside(self, task: str) -> Iterator[Clue]:
        """Yield what a task reads that is in no recording."""
        layout = self.runs[0].layout
        hosts = {host.name for host in layout.hosts}
        for box in layout.mailboxes:
            if task in box.readers and box.writer in hosts:
                text = f"{box.name}, of the host board '{box.writer}', is not recorded"
                yield Clue("outside", text)
        if task == LAN:
            yield Clue("outside", "what comes from the network is not recorded")


def _unlike_signal(signal: Signal, here: np.ndarray, there: np.ndarray) -> Iterator[InBoth]:
    """Yield a field that differs in two messages, each (1,): of an array its first such number."""
    values = [signal.values(message)[0] for message in (here, there)]
    if values[0].tobytes() == values[1].tobytes():
        return
    plain = [signal.plain(message)[0] for message in (here, there)]
    index = ""
    # Zeros of either sign are equal, and differ: such an array is shown whole.
    for place in np.argwhere(values[0] != values[1])[:1].tolist():
        index = "".join(f"[{number}]" for number in place)
        plain = [np.array(value, "O")[tuple(place)] for value in plain]
    yield InBoth(f"{signal.name}{index}", *plain)


def unlike_values(here: Mapping[str, Any], there: Mapping[str, Any]) -> Iterator[InBoth]:
    """Yield the values that differ in two tables, by dotted names."""
    own = dict(_dotted(here))
    other = dict(_dotted(there))
    for name in dict.fromkeys((*own, *other)):
        if own.get(name) != other.get(name):
            yield InBoth(name, own.get(name), other.get(name))


def _dotted(found: Mapping[str, Any], outer: str = "") -> Iterator[tuple[str, Any]]:
    """Yield values with those of tables in them, by dotted names; of lists of tables by number."""
    for name, value in found.items():
        is_tables = isinstance(value, list) and value and isinstance(value[0], dict)
        if isinstance(value, dict):
            yield from _dotted(value, f"{outer}{name}.")
        elif is_tables:
            tables = {f"{name}[{at}]": table for at, table in enumerate(value)}
            yield from _dotted(tables, outer)
        else:
            yield f"{outer}{name}", value
