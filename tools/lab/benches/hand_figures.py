"""The figures by which the two racks of one hand are compared, as tables and a picture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rack.tools.console.pictures import paths_of, picture
from rack.tools.console.tables import decimal, table

if TYPE_CHECKING:
    from matplotlib.axes import Axes

COLOURS = ("#4477aa", "#ee6677", "#228833", "#ccbb44")
GRID = "#bbccdd"
LINEAR_MS = 0.1
"""Times below it are on a linear scale: an exact exchange has no jitter."""
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
class HandBench:
    """Every rack in both modes."""

    figures: tuple[HandFigures, ...]

    @property
    def worked(self) -> bool:
        """Whether all runs did their task."""
        return not any(one.failure for one in self.figures)

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return {
            "bench": "hand",
            "racks": [asdict(one) for one in self.figures],
            "worked": self.worked,
        }

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
            head, [_rack_row(one) for one in self.figures], width, ("the rest", "handlers")
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
        for one in self.figures:
            if one.failure:
                yield f"{one.name}: {one.failure}"

    def _link_rows(self) -> Iterator[list[str]]:
        """Yield a row per link; the racks in both modes under each other, message by message."""
        for message in self.messages:
            for one in self.figures:
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
                        *map(str, (link.sent, link.lost, link.overtaken)),
                    ]

    @property
    def messages(self) -> list[str]:
        """The types of messages, in the order of the first rack's links."""
        return list(dict.fromkeys(link.message for one in self.figures for link in one.links))

    def plot(self, folder: Path) -> list[Path]:
        """Write hand.png and hand.svg into `folder`; return their paths."""
        paths = paths_of(folder / "hand")
        with picture(paths, 11.0, 1.4 + 0.6 * len(self.messages), layout="constrained") as drawn:
            axes = drawn.subplots(1, 3, sharey=True, width_ratios=(3, 3, 2))
            self._draw(axes[0], "age", "age when read, ms")
            self._draw(axes[1], "jitter", "jitter of arrival, ms")
            self._draw_lost(axes[2])
            axes[0].set_yticks(range(len(self.messages)), self.messages)
            axes[0].invert_yaxis()
            for each in axes:
                each.grid(axis="x", color=GRID, linewidth=0.4)
                each.spines[["top", "right"]].set_visible(False)
            drawn.legend(
                *axes[0].get_legend_handles_labels(),
                loc="outside lower center",
                ncols=4,
                frameon=False,
            )
        return paths

    def _draw(self, axes: Axes, what: str, label: str) -> None:
        """Draw a line from the median to the largest of one figure, in the row of each message."""
        for number, one in enumerate(self.figures):
            rows = [(self._row(number, link), link) for link in one.links]
            spans = [
                (row, getattr(link, f"{what}_p50_ms"), getattr(link, f"{what}_max_ms"))
                for row, link in rows
                if getattr(link, f"{what}_p50_ms") is not None
            ]
            at, middle, most = zip(*spans, strict=True) if spans else ((), (), ())
            colour = COLOURS[number % len(COLOURS)]
            axes.hlines(at, middle, most, color=colour, linewidth=2)
            axes.plot(middle, at, "o", color=colour, markersize=5, label=one.name)
        from matplotlib.ticker import StrMethodFormatter

        axes.set_xscale("symlog", linthresh=LINEAR_MS)
        axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.set_xlabel(label)
        axes.set_xlim(left=0.0)

    def _draw_lost(self, axes: Axes) -> None:
        for number, one in enumerate(self.figures):
            colour = COLOURS[number % len(COLOURS)]
            for link in one.links:
                part = 100.0 * link.lost / max(link.sent, 1)
                axes.barh(self._row(number, link), part, 0.8 / len(self.figures), color=colour)
        axes.set_xlabel("lost, % of messages")
        axes.set_xlim(0.0, max(1.0, axes.get_xlim()[1]))

    def _row(self, number: int, link: LinkFigures) -> float:
        offset = (number - 0.5 * (len(self.figures) - 1)) / (len(self.figures) + 1)
        return self.messages.index(link.message) + offset


def _rack_row(one: HandFigures) -> Sequence[str]:
    times = (one.exchange_ms, one.process_ms, one.handler_ms)
    return [
        one.name,
        decimal(one.shift_mm, 2),
        decimal(one.left_mm, 2),
        *(f"{time:.1f}" for time in times),
        str(one.missed),
        str(one.cycles),
        "failed" if one.failure else "done",
    ]
