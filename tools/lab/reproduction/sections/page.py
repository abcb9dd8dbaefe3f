"""The page as data: sections of claims, each with the paper's words, our prediction, our
measurement and a ruling; and a claim before it is judged, which becomes one of the page.

Texts are HTML of a few inline tags (`<i>`, `<b>`, `<sub>`, `<sup>`, `<code>`), which Markdown takes
too.
"""

from __future__ import annotations

import operator
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from html import escape, unescape
from pathlib import Path
from typing import Any, NamedTuple

from rack.tools.lab.reproduction.experiments.experiment import (
    Document,
    Experiment,
    Kept,
    Workshop,
)


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
"""Cells of a table: texts and counts, None as "-", a truth as "yes" or "NO"."""


def _cell(value: str | int | None) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "NO"
    return str(value)


@dataclass(frozen=True)
class Columns:
    """A table. Columns of numbers are aligned to the right."""

    head: Sequence[str]
    rows: Sequence[Row]
    caption: str = ""

    @property
    def cells(self) -> list[list[str]]:
        """The rows as texts of the page."""
        return [list(map(_cell, row)) for row in self.rows]


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


DONE = "task done"
"""The end of a run that has done its task."""
STRAY = 0.02
"""Part of cycles, plans or messages missed up to which this machine, not the claim, is seen."""
SIGNS = {"<": "&lt;", "<=": "≤", ">": "&gt;", ">=": "≥", "=": "="}
COMPARED = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "=": operator.eq,
}


class Requirement(NamedTuple):
    """What a claim demands of a measured value, and whether it is met."""

    of: str
    measured: float
    sign: str
    limit: float
    unit: str = ""

    @property
    def is_met(self) -> bool:
        """Whether the measured value satisfies the demand."""
        return bool(COMPARED[self.sign](self.measured, self.limit))

    @property
    def row(self) -> Row:
        """The demand as a row of the page."""
        measured = f"{self.measured:.6g} {self.unit}".rstrip()
        limit = f"{SIGNS[self.sign]} {self.limit:.6g} {self.unit}".rstrip()
        return self.of, measured, limit, self.is_met

    def __str__(self) -> str:
        of, measured, limit, _ = self.row
        return f"{of}: {measured}, demanded {limit}"


class ClaimVerdict(NamedTuple):
    """A ruling, its reason in one or two sentences, and the comparisons that it results from."""

    ruling: Ruling
    why: str
    demands: Sequence[Requirement]


def ruled(
    claim: Sequence[Requirement],
    why: str,
    *,
    here: Sequence[Requirement] = (),
    needs: Sequence[Requirement] = (),
    holding: Ruling = Ruling.HOLDS,
) -> ClaimVerdict:
    """Rule on a claim by comparisons alone; `why` is its reason if it holds.

    It is not judged by a run that lacks what it `needs`. It holds, or gets the ruling `holding`, if
    every demand of the `claim` is met, and holds within bounds if at least those of `here` are: the
    same claim, with what this machine disturbs taken into account.
    """
    assert claim or unmet(needs), "a ruling without a comparison cannot fail"
    demands = list(dict.fromkeys((*needs, *claim, *here)))
    if lacking := unmet(needs):
        return ClaimVerdict(Ruling.UNTESTABLE, f"Not judged. {lacking}.", demands)
    if not (broken := unmet(claim)):
        return ClaimVerdict(holding, why, demands)
    if here and not unmet(here):
        return ClaimVerdict(Ruling.BOUNDED, f"Within wider bounds only. {broken}.", demands)
    return ClaimVerdict(Ruling.FAILS, f"{unmet(here) or broken}.", demands)


def ruled_strays(
    what: str, bad: int, due: int, why: str, needs: Sequence[Requirement] = ()
) -> ClaimVerdict:
    """Rule on something that must not happen; within bounds, in no more than a stray part."""
    return ruled(
        (Requirement(what, bad, "=", 0),),
        why,
        here=(Requirement(f"{what}, part of all", bad / max(due, 1), "<=", STRAY),),
        needs=(*needs, Requirement("of how many", due, ">=", 1)),
    )


def unmet(demands: Sequence[Requirement]) -> str:
    """Return the demands that are not met, in words."""
    return "; ".join(str(demand) for demand in demands if not demand.is_met)


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
    facts: tuple[tuple[str, str], ...] = ()

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


PAPER: dict[str, dict[str, dict[str, str]]] = tomllib.loads(
    Path(__file__).with_name("paper.toml").read_text(encoding="utf-8")
)
"""The paper's words, by section and by claim."""


class Wording(NamedTuple):
    """A claim in the paper's words. An equation also has a `form`, our `reading` of it, and words
    for the rack of its `failure`."""

    title: str
    quote: str
    form: str = ""
    reading: str = ""
    failure: str = ""


def wording(claim: str) -> Wording:
    """Return the words of a claim."""
    return Wording(**_texts("claim", claim))


def _texts(table: str, name: str) -> dict[str, str]:
    """Return texts of the paper; how they are broken into lines means nothing."""
    return {key: " ".join(words.split()) for key, words in PAPER[table][name].items()}


@dataclass(frozen=True)
class Statement:
    """A claim of the paper by its name, with the experiments that it rests on.

    `predicted` computes our side from configs alone; `measured` shows what the experiments have
    found, and `judged` rules on that: both are given their records, in their order. The first two
    may draw.
    """

    name: str
    experiments: tuple[Experiment[Any], ...]
    judged: Callable[..., ClaimVerdict]
    predicted: Callable[[Workshop], Side] = lambda workshop: []
    measured: Callable[..., Side] = lambda workshop, *found: []

    def claim(self, workshop: Workshop, results: Mapping[str, Kept | str]) -> PageClaim:
        """Return the claim with its ruling; a text among the `results` says why there is none."""
        words = wording(self.name)
        return PageClaim(
            name=self.name,
            title=words.title,
            quote=words.quote,
            predicted=self.predicted(workshop),
            tested=self._tested(workshop, results),
            equation=words.form,
        )

    def _tested(self, workshop: Workshop, results: Mapping[str, Kept | str]) -> Assessment:
        found: dict[str, Document] = {}
        for experiment in self.experiments:
            name = experiment.name
            result = results.get(name, "")
            if isinstance(result, str):
                reason = "; <code>rack reproduce</code> with the same folder goes on"
                if result:
                    reason = f": {text(result)}"
                words = f"The experiment {text(name)} has not been made{reason}."
                return Assessment([], Ruling.UNMADE, words)
            if result.lacking:
                return Assessment([], Ruling.UNTESTABLE, f"{text(result.lacking)}.")
            found[name] = result.found
        return self.tested(found, workshop)

    def tested(self, documents: Mapping[str, Document], workshop: Workshop) -> Assessment:
        """Return what was measured with the comparisons made of it, and the ruling; `documents` are
        what was found, by experiment."""
        found = [one.record(documents[one.name]) for one in self.experiments]
        verdict = self.judged(*found)
        head = ("compared", "measured", "demanded", "met")
        compared = Columns(head, [demand.row for demand in verdict.demands])
        return Assessment([*self.measured(workshop, *found), compared], verdict.ruling, verdict.why)


@dataclass(frozen=True)
class Chapter:
    """A section of the paper with its claims; `name` is its number, as in "3.1", or "abstract"."""

    name: str
    statements: tuple[Statement, ...]

    def section(self, workshop: Workshop, results: Mapping[str, Kept | str]) -> PageSection:
        """Return the section with every claim judged."""
        claims = tuple(statement.claim(workshop, results) for statement in self.statements)
        return PageSection(self.name, claims=claims, **_texts("section", self.name))
