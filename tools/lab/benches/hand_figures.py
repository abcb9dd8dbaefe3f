"""The figures by which the two racks of one hand are compared, as tables and a picture."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rack.tools.console.tables import decimal, table
from rack.tools.lab.benches.chart import Diagram, Series, draw, marks
from rack.tools.lab.benches.harness import BenchResult

NARROW = ("overtaken", "sent", "age p50", "jitter p50", "protocol")
"""Columns of the links that a narrow terminal leaves out, in this order."""


@dataclass(frozen=True)
class LinkFigures:
    """All mailboxes of one type of message that go the same way: the largest figure of any, counts
    of all; times in ms.

    Jitter is that of arrival, ages are those when they are read. Lost messages never arrived; of an
    overtaken one a newer one arrived before it was read: see
    `rack.tools.lab.benches.exchange_times`.
    """

    message: str
    writers: str
    readers: str
    protocol: str
    period_ms: float
    jitter_p50_ms: float | None
    jitter_max_ms: float | None
    age_p50_ms: float | None
    age_max_ms: float | None
    sent: int
    lost: int
    overtaken: int

    def lost_percent(self) -> float:
        """Return the share of messages that never arrived, %."""
        return 100.0 * self.lost / max(self.sent, 1)


@dataclass(frozen=True)
class HandFigures:
    """One rack in one mode, over its rounds; the largest figure of any.

    `shift_mm` is how far the pulls move the object, `left_mm` how far it is afterwards from where
    it was before them; None: it was not held then. `exchange_ms` and `process_ms` are processor
    times of all boards in a second, for messages and for the rest, `handler_ms` that of interrupts
    by their cost model: in real time a part of the first.
    """

    rack: str
    mode: str
    rounds: int
    links: tuple[LinkFigures, ...]
    shift_mm: float | None
    left_mm: float | None
    exchange_ms: float
    process_ms: float
    handler_ms: float
    missed: int
    cycles: int
    digests: tuple[str, ...]
    failure: str

    @property
    def name(self) -> str:
        """Rack and mode."""
        return f"{self.rack}, {self.mode}"


@dataclass(frozen=True)
class HandBench(BenchResult):
    """Every rack in both modes."""

    name = "hand"
    DERIVED = ("worked",)

    racks: tuple[HandFigures, ...]

    @property
    def worked(self) -> bool:
        """Whether all runs did their task."""
        return not any(one.failure for one in self.racks)

    def lines(self, width: int | None = None) -> Iterator[str]:
        """Yield both tables for people, fitted to `width`."""
        yield (
            "the object under the pulls, mm; processor time a second of all boards, ms; cycles"
            " missed or skipped"
        )
        head = [
            "rack",
            "shift",
            "left",
            "messages",
            "the rest",
            "handlers",
            "missed",
            "of cycles",
            "task",
        ]
        yield from table(
            head, [_rack_row(one) for one in self.racks], width, ("the rest", "handlers")
        )
        yield ""
        yield "messages on every link, ms: jitter of arrival, age when they are read"
        head = [
            "message",
            "rack",
            "from > to",
            "protocol",
            "period",
            "jitter p50",
            "jitter max",
            "age p50",
            "age max",
        ]
        yield from table(
            [*head, "sent", "lost", "overtaken"], list(self._link_rows()), width, NARROW
        )
        for one in self.racks:
            if one.failure:
                yield f"{one.name}: {one.failure}"

    def _link_rows(self) -> Iterator[list[str]]:
        """Yield a row per link; the racks in both modes under each other, message by message."""
        for message in self.messages:
            for one in self.racks:
                for link in (link for link in one.links if link.message == message):
                    yield [
                        message,
                        one.name,
                        f"{link.writers} > {link.readers}",
                        link.protocol,
                        f"{link.period_ms:g}",
                        decimal(link.jitter_p50_ms),
                        decimal(link.jitter_max_ms),
                        decimal(link.age_p50_ms),
                        decimal(link.age_max_ms),
                        f"{link.sent}",
                        f"{link.lost}",
                        f"{link.overtaken}",
                    ]

    @property
    def messages(self) -> list[str]:
        """The types of messages, in the order of the first rack's links."""
        return list(dict.fromkeys(link.message for one in self.racks for link in one.links))

    def plot(self, folder: Path) -> list[Path]:
        """Write ages, jitter and losses, a row a type of messages, into `folder`; return the
        paths."""
        panels = [
            Diagram("age when read, longest, ms", self._series(lambda link: link.age_max_ms)),
            Diagram("jitter of arrival, most, ms", self._series(lambda link: link.jitter_max_ms)),
            Diagram("lost, % of messages", self._series(LinkFigures.lost_percent)),
        ]
        return draw(folder / "hand", "", panels, self.messages)

    def _series(self, value: Callable[[LinkFigures], float | None]) -> list[Series]:
        """Return a series of marks for each rack and mode."""
        found = []
        for number, one in enumerate(self.racks):
            lower = (number + 0.5) / len(self.racks) - 0.5
            known = [
                (figure, self.messages.index(link.message) + 0.8 * lower)
                for link in one.links
                if (figure := value(link)) is not None
            ]
            found.append(marks(one.name, known))
        return found


def _rack_row(one: HandFigures) -> Sequence[str]:
    times = (one.exchange_ms, one.process_ms, one.handler_ms)
    ended = "failed" if one.failure else "done"
    return [
        one.name,
        decimal(one.shift_mm, 2),
        decimal(one.left_mm, 2),
        *(f"{time:.1f}" for time in times),
        f"{one.missed}",
        f"{one.cycles}",
        ended,
    ]
