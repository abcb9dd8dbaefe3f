"""The page as data: sections of claims, each with the paper's words, our prediction, our
measurement and a ruling.

Texts are HTML of a few inline tags (`<i>`, `<b>`, `<sub>`, `<sup>`, `<code>`), which Markdown takes
too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from html import escape, unescape
from pathlib import Path
from typing import Any


class Ruling(StrEnum):
    """What became of a claim."""

    HOLDS = "holds"
    BOUNDED = "holds here, within bounds"
    CONTRADICTS = "the paper contradicts itself"
    UNTESTABLE = "not testable here"
    FAILS = "does not hold here"
    UNMADE = "not run yet"

    @property
    def is_failure(self) -> bool:
        """Whether the page must not count as a success."""
        return self in (Ruling.FAILS, Ruling.UNMADE)


Row = Sequence[str | int | None]
"""Cells of a table: texts and counts; None shows as "-"."""


@dataclass(frozen=True)
class Columns:
    """A table. Columns of numbers are aligned to the right."""

    head: Sequence[str]
    rows: Sequence[Row]
    caption: str = ""

    @property
    def cells(self) -> list[list[str]]:
        """The rows as texts of the page."""
        return [["-" if cell is None else str(cell) for cell in row] for row in self.rows]


@dataclass(frozen=True)
class Plate:
    """A picture, by its path within the folder of the page, and what it shows."""

    path: Path
    caption: str


@dataclass(frozen=True)
class Listing:
    """Text of fixed width, as it is."""

    text: str
    caption: str = ""


Item = str | Columns | Plate | Listing
"""What stands below each other on the page; a text is a paragraph."""
Side = list[Item]
"""What is said of a claim from one side: predicted, or measured."""


@dataclass(frozen=True)
class Assessment:
    """The measurement of a claim, the ruling, and its reason in one or two sentences."""

    measured: Side
    ruling: Ruling
    why: str


@dataclass(frozen=True)
class PageClaim:
    """A claim on the page. `equation` is empty where the claim is none; `name` is its anchor."""

    name: str
    title: str
    quote: str
    predicted: Side
    tested: Assessment
    equation: str = ""

    def document(self) -> dict[str, Any]:
        """Return the claim as plain data, without its pictures."""
        tested = self.tested
        return {
            "claim": self.name,
            "title": plain(self.title),
            "quote": plain(self.quote),
            "ruling": tested.ruling.name.lower(),
            "why": plain(tested.why),
            "predicted": list(_plain_items(self.predicted)),
            "measured": list(_plain_items(tested.measured)),
        }


@dataclass(frozen=True)
class PageSection:
    """A section of the paper. `number` is empty for the abstract."""

    name: str
    title: str
    intro: str
    claims: tuple[PageClaim, ...]


@dataclass(frozen=True)
class Page:
    """The whole page; `facts` are pairs about the machine and the runs."""

    sections: tuple[PageSection, ...]
    facts: tuple[tuple[str, str], ...] = field(default=())

    @property
    def claims(self) -> list[PageClaim]:
        """All claims, in the paper's order."""
        return [claim for section in self.sections for claim in section.claims]

    def of(self, ruling: Ruling) -> list[PageClaim]:
        """Return the claims with this ruling."""
        return [claim for claim in self.claims if claim.tested.ruling is ruling]

    def document(self) -> dict[str, Any]:
        """Return the page as plain data."""
        return {
            "facts": {name: plain(value) for name, value in self.facts},
            "rulings": {ruling.name.lower(): len(self.of(ruling)) for ruling in Ruling},
            "sections": [
                {
                    "section": one.name,
                    "title": one.title,
                    "claims": [claim.document() for claim in one.claims],
                }
                for one in self.sections
            ],
        }


def text(value: object) -> str:
    """Return anything as text of the page, with its special characters escaped."""
    return escape(str(value), quote=False)


def code(value: object) -> str:
    """Return a name or a command as it is written in a program."""
    return f"<code>{text(value).replace('|', '&#124;').replace('*', '&#42;')}</code>"


def plain(value: str) -> str:
    """Return a text of the page without its tags: an index follows "_", a power "^"."""
    for tag, character in (("sub", "_"), ("sup", "^")):
        value = value.replace(f"<{tag}>", character).replace(f"</{tag}>", "")
    for tag in ("i", "b", "code"):
        value = value.replace(f"<{tag}>", "").replace(f"</{tag}>", "")
    return unescape(value)


def _plain_items(side: Side) -> Iterator[Any]:
    for item in side:
        match item:
            case str():
                yield plain(item)
            case Columns(head):
                names = [plain(name) for name in head]
                yield [dict(zip(names, map(plain, row), strict=True)) for row in item.cells]
            case Plate(path):
                yield {"picture": str(path)}
            case Listing(lines):
                yield lines.splitlines()
