"""Finds the reason why two recorded runs diverge.

Messages become visible at ticks, so a recording contains everything that a task had read at a
release: all messages visible until that tick. Starting at the first message that differs, the
search goes back through the inputs that differed, from cycle to earlier cycle. It ends at a task
whose inputs were equal in both runs. The cause is then an event (a fault, a death, a missed cycle),
a setting, the code of the level, or the state of the level. No recording contains the last two: see
`rack.tools.report.cycle_again`.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from rack.backplane.address_map import CLOCK
from rack.backplane.bounded_toml import load_toml
from rack.backplane.fault_table import NEVER
from rack.backplane.layout import MailboxSpec, TaskSpec
from rack.boards.config.schema import LAN
from rack.tools.recording.divergence import (
    DivergentMessage,
    find_common_ticks,
    find_row,
    list_divergent_messages,
)
from rack.tools.recording.history import list_misses
from rack.tools.recording.recording import Recording
from rack.tools.recording.signal import Signal, find_mailbox, list_signals

ClueKind = Literal["fault", "died", "command", "demand", "late", "skipped", "config", "outside"]
CLUES_BY_EVENT: Mapping[str | None, ClueKind] = {
    "fault": "fault",
    "died": "died",
    "command": "command",
    "demand": "demand",
}
"""Kind of clue for each event kind or event code whose cause lies outside the messages."""
MISS_TEXTS = {"late": "'{}' missed its deadline", "skipped": "'{}' skipped this cycle"}
IGNORED_KEYS = ("name", "record.", "clock.mode", "clock.speed", "fault", "command", "python_path")
"""Prefixes of config keys that cannot cause a difference, or whose effects are recorded as events.
"""


@dataclass(frozen=True)
class ValueDifference:
    """A field, setting or attribute whose value differs between two runs.

    Attributes:
        name: Its name.
        here: Value in the first run, or None if that run has none.
        there: Value in the other run, or None if that run has none.
    """

    name: str
    here: Any
    there: Any


@dataclass(frozen=True)
class Clue:
    """A possible cause of a difference.

    Attributes:
        kind: Kind of the clue.
        text: The clue as a sentence for the user.
        run: Folder of the run in which it happened, or "" if it applies to both.
        tick: Tick at which it happened, or -1 if it applies from the start.
        values: The setting that differs, for clues of kind "config".
    """

    kind: ClueKind
    text: str
    run: str = ""
    tick: int = -1
    values: ValueDifference | None = None


@dataclass(frozen=True)
class DivergentCycle:
    """The cycle in which a task wrote the first differing message of a mailbox.

    Attributes:
        tick: Release tick of the cycle.
        mailbox: The mailbox.
        writer: The task that wrote the message.
        fields: Fields of the message that differ.
        read: Mailboxes that the task reads.
        unequal: The mailbox among `read` whose messages differed earliest before this cycle; the
            search continues there. "" if all inputs were equal.
        clues: Possible causes in this cycle.
    """

    tick: int
    mailbox: str
    writer: str
    fields: tuple[ValueDifference, ...]
    read: tuple[str, ...]
    unequal: str
    clues: tuple[Clue, ...]


class Divergence:
    """Comparison of two runs that finds their first differing messages and the causes.

    Raises `Failure` if the runs are of different racks, or if one of them lacks rows.

    Attributes:
        runs: The two runs.
        divergent: First differing message of each mailbox that differs, earliest first.
    """

    def __init__(self, first_run: Recording, second_run: Recording) -> None:
        self.runs = first_run, second_run
        self.divergent = {
            message.mailbox: message for message in list_divergent_messages(first_run, second_run)
        }
        self._begin, _ = find_common_ticks(first_run, second_run)

    def trace_cause(self, mailbox: str) -> tuple[DivergentCycle, ...]:
        """Trace a difference back to its cause.

        Args:
            mailbox: Mailbox whose first differing message is explained. Defaults to the mailbox
                that differs first.

        Returns:
            The cycles from that message back to the cause, latest first. Empty if the mailbox does
            not differ.

        Raises:
            Failure: The mailbox does not exist.
        """
        if mailbox:
            find_mailbox(mailbox, self.runs[0].layout.timed)
        name = mailbox or next(iter(self.divergent), "")
        cycles: dict[str, DivergentCycle] = {}
        # Messages that become visible immediately can form a loop within one tick.
        while name in self.divergent and name not in cycles:
            cycles[name] = self._describe_cycle(self.divergent[name])
            name = cycles[name].unequal
        return tuple(cycles.values())

    def _describe_cycle(self, message: DivergentMessage) -> DivergentCycle:
        """Return the cycle that wrote a differing message, with its inputs and possible causes."""
        layout = self.runs[0].layout
        box = layout.find_mailbox(message.mailbox)
        read = [source for source in layout.timed if box.writer in source.readers]
        unequal = [
            source.name for source in read if self._has_read_difference(source, box.writer, message)
        ]
        first = min(unequal, key=lambda name: self.divergent[name].tick, default="")
        clues = [*self._find_event_clues(box, message)]
        if box.writer != CLOCK:
            clues += self._find_miss_clues(layout.find_task(box.writer), message.tick)
            if not first:
                clues += self._find_config_clues(box.writer)
                clues += self._find_unrecorded_inputs(box.writer)
        return DivergentCycle(
            tick=message.tick,
            mailbox=box.name,
            writer=box.writer,
            fields=tuple(self._list_different_fields(box, message.serial)),
            read=tuple(source.name for source in read),
            unequal=first,
            clues=tuple(clues),
        )

    def _has_read_difference(
        self, source: MailboxSpec, reader: str, message: DivergentMessage
    ) -> bool:
        """Return True if a task had read a differing input when it wrote a differing message.

        Args:
            source: Mailbox that the task reads.
            reader: The task.
            message: First differing message of a mailbox that the task writes. The input counts
                only if it was visible in the cycle that wrote this message.
        """
        earlier = self.divergent.get(source.name)
        grid = self.runs[0].layout.find_read_grid(source, reader)
        release = message.tick - (message.tick - grid.phase) % grid.every
        return (
            earlier is not None
            and earlier.visible_at <= release
            and earlier.mailbox != message.mailbox
        )

    def _list_different_fields(self, box: MailboxSpec, serial: int) -> Iterator[ValueDifference]:
        """Yield the fields of a message that differ.

        If the messages come from different cycles, only "tick" is yielded.
        """
        here, there = (find_row(run, box, serial) for run in self.runs)
        ticks = (None if row is None else int(row["tick"]) for row in (here, there))
        if here is None or there is None or here["tick"] != there["tick"]:
            # Messages from different cycles are expected to differ in their other fields.
            yield ValueDifference("tick", *ticks)
            return
        if here["visible_at"] != there["visible_at"]:
            yield ValueDifference("visible_at", int(here["visible_at"]), int(there["visible_at"]))
        for signal in list_signals(box):
            yield from _compare_signal(signal, here["message"][None], there["message"][None])
        if here["basis"] != there["basis"]:
            yield ValueDifference("basis", int(here["basis"]), int(there["basis"]))

    def _find_event_clues(self, box: MailboxSpec, message: DivergentMessage) -> Iterator[Clue]:
        """Yield a clue for each event that may have caused a differing message.

        The event occurred in only one run, not later than the message, and concerns the writer of
        the message or the whole rack.
        """
        boards = {name.partition(".")[0] for name in (box.writer, box.name)}
        about = {CLOCK, box.writer, box.name, *boards}
        event_clues = [self._list_event_clues(run) for run in self.runs]
        for this_run, other_run, run in zip(
            event_clues, reversed(event_clues), self.runs, strict=True
        ):
            row = find_row(run, box, message.serial)
            # A death is reported only after messages are already missing. Accept deaths up to the
            # tick at which the run wrote this serial, or up to its end if it never did.
            written = NEVER if row is None else int(row["tick"])
            unmatched = Counter(key for key, _ in other_run)
            for key, clue in this_run:
                # A level reads commands as messages, so they are already compared as its inputs.
                if clue.kind == "command" and box.writer != CLOCK:
                    continue
                unmatched[key] -= 1
                until = written if clue.kind == "died" else message.tick
                if unmatched[key] < 0 and not about.isdisjoint(key[1:3]) and clue.tick <= until:
                    yield clue

    def _list_event_clues(self, run: Recording) -> list[tuple[tuple[str, ...], Clue]]:
        """Return a clue for each death, fault, command or demand since the first common tick.

        Each clue follows its key: kind, board, subject and text. Two events with equal keys count
        as the same event in both runs.
        """
        clues: list[tuple[tuple[str, ...], Clue]] = []
        for event in run.events:
            kind = CLUES_BY_EVENT.get(event.get("code")) or CLUES_BY_EVENT.get(event["kind"])
            if kind is not None and event["tick"] >= self._begin:
                # The text of a death contains a process id, which always differs.
                text = "" if kind == "died" else f"{event['tick']} {event['text']}"
                clue = Clue(kind, event["text"], str(run.folder), event["tick"])
                clues.append(((kind, event["board"], event["subject"], text), clue))
        return clues

    def _find_miss_clues(self, task: TaskSpec, tick: int) -> Iterator[Clue]:
        """Yield a clue if the task missed or skipped its cycle at `tick` in only one run."""
        miss_clues = [
            Clue(miss["what"], MISS_TEXTS[miss["what"]].format(task.name), str(run.folder), tick)
            for run in self.runs
            for miss in list_misses(run)
            if miss["task"] == task.name
            and miss["tick"] <= tick < miss["tick"] + miss["count"] * task.every
        ]
        if len({clue.run for clue in miss_clues}) == 1:
            yield from miss_clues

    def _find_config_clues(self, task: str) -> Iterator[Clue]:
        """Yield a clue for each setting of the task's board that differs between the runs.

        If all settings of the board are equal, the rest of the config is compared instead.
        """
        tables = (load_toml(run.config) for run in self.runs)
        differences = [
            difference
            for difference in compare_values(*tables)
            if not difference.name.startswith(IGNORED_KEYS)
        ]
        board = f"board.{task.partition('.')[0]}."
        of_board = [difference for difference in differences if difference.name.startswith(board)]
        for difference in of_board or differences:
            yield Clue("config", f"{difference.name} differs", values=difference)

    def _find_unrecorded_inputs(self, task: str) -> Iterator[Clue]:
        """Yield a clue for each input of a task that is not recorded, such as network messages."""
        layout = self.runs[0].layout
        hosts = {host.name for host in layout.hosts}
        for box in layout.mailboxes:
            if task in box.readers and box.writer in hosts:
                text = f"messages of the host board '{box.writer}' are not recorded: {box.name}"
                yield Clue("outside", text)
        if task == LAN:
            yield Clue("outside", "messages from the network are not recorded")


def _compare_signal(
    signal: Signal, here: np.ndarray, there: np.ndarray
) -> Iterator[ValueDifference]:
    """Yield the two values of a field in two messages, or nothing if they are equal.

    For an array field only the first differing element is yielded.

    Args:
        signal: The field.
        here: Message of the first run, shape (1,).
        there: Message of the other run, shape (1,).
    """
    values = [signal.extract_values(message)[0] for message in (here, there)]
    if values[0].tobytes() == values[1].tobytes():
        return
    plain = [signal.extract_plain(message)[0] for message in (here, there)]
    index = ""
    # 0.0 and -0.0 compare as equal but have different bytes. In that case the loop
    # finds no element, and the whole array is reported.
    for place in np.argwhere(values[0] != values[1])[:1].tolist():
        index = "".join(f"[{number}]" for number in place)
        plain = [np.array(value, "O")[tuple(place)] for value in plain]
    yield ValueDifference(f"{signal.name}{index}", *plain)


def compare_values(here: Mapping[str, Any], there: Mapping[str, Any]) -> Iterator[ValueDifference]:
    """Compare two nested tables. Yield differing values with their paths, as in `clock.mode`."""
    here_values = dict(_flatten_table(here))
    there_values = dict(_flatten_table(there))
    for name in dict.fromkeys((*here_values, *there_values)):
        if here_values.get(name) != there_values.get(name):
            yield ValueDifference(name, here_values.get(name), there_values.get(name))


def _flatten_table(table: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the path and the value of each entry of a nested table.

    The keys of a path are separated by dots. Tables in a list get an index, as in `fault[0].kind`.
    """
    for name, value in table.items():
        is_tables = isinstance(value, list) and value and isinstance(value[0], dict)
        if isinstance(value, dict):
            yield from _flatten_table(value, f"{prefix}{name}.")
        elif is_tables:
            tables = {f"{name}[{index}]": entry for index, entry in enumerate(value)}
            yield from _flatten_table(tables, prefix)
        else:
            yield f"{prefix}{name}", value
