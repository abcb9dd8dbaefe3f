"""The page: claims of the paper with predictions, measurements and rulings, as data, as Markdown,
and as HTML.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from jinja2 import Environment, FileSystemLoader
from markdown_it import MarkdownIt
from pydantic import TypeAdapter

from rack.tools.console.answer import Document
from rack.tools.lab.reproduction.experiments.experiment import Charted, Experiment, Kept
from rack.tools.lab.reproduction.verdict import Check, ClaimVerdict, Ruling, describe_unmet


@dataclass(frozen=True)
class Evidence:
    """One thing shown for a claim: comparisons, or text of fixed width. `source` is the command
    that it comes from.
    """

    source: str = ""
    checks: tuple[Check, ...] = ()
    text: str = ""


@dataclass(frozen=True)
class JudgedClaim:
    """A claim on the page; `why` is its rule in words, or the comparisons that are not met."""

    claim: str
    title: str
    quote: str
    predicted: tuple[Evidence, ...]
    measured: tuple[Evidence, ...] = ()
    ruling: Ruling = Ruling.UNMADE
    why: str = ""


@dataclass(frozen=True)
class PaperClaim:
    """A claim of the paper, with its experiments and its rule.

    Attributes:
        name: Its anchor on the page.
        title: Its heading.
        quote: The paper's sentence.
        why: The reason for its ruling if every comparison is met.
        experiments: Experiments whose records `judge` takes, in this order.
        judge: Its rule.
        predict: Returns what follows from configs alone.
    """

    name: str
    title: str
    quote: str
    why: str
    experiments: tuple[Experiment[Any], ...]
    judge: Callable[..., ClaimVerdict]
    predict: Callable[[], tuple[Evidence, ...]] = lambda: ()

    def judge_by(self, results: Mapping[str, Kept | str]) -> JudgedClaim:
        """Return the claim with its ruling; a text among the `results` says why there is none."""
        unruled = JudgedClaim(self.name, self.title, self.quote, self.predict())
        found = []
        for one in self.experiments:
            result = results.get(one.name, "not run yet")
            if isinstance(result, str):
                return replace(unruled, why=f"{one.name}: {result}")
            if result.lacking:
                return replace(unruled, ruling=Ruling.UNTESTABLE, why=result.lacking)
            found.append(one.record(result.found))
        verdict = self.judge(*found)
        charts = [Evidence(text=run.chart) for run in found if isinstance(run, Charted)]
        return replace(
            unruled,
            ruling=verdict.ruling,
            why=describe_unmet(verdict.checks) or self.why,
            measured=(*charts, Evidence(checks=verdict.checks)),
        )


C = TypeVar("C")


@dataclass(frozen=True)
class Section(Generic[C]):
    """A section of the paper by its number, as in "3.1", or "abstract", with its claims."""

    section: str
    title: str
    claims: tuple[C, ...]


@dataclass(frozen=True)
class Page:
    """The whole page; `facts` are about the machine and the runs."""

    facts: dict[str, str]
    rulings: dict[Ruling, int]
    sections: tuple[Section[JudgedClaim], ...]

    def document(self) -> Document:
        """Return the page as plain data."""
        return dict(TypeAdapter(Page).dump_python(self, mode="json"))


LABELS = {
    Ruling.HOLDS: "✓ holds",
    Ruling.BOUNDED: "≈ holds here, within bounds",
    Ruling.CONTRADICTS: "↯ the paper contradicts itself",
    Ruling.UNTESTABLE: "∅ not testable here",
    Ruling.FAILS: "✗ does not hold here",
    Ruling.UNMADE: "… not run yet",
}
"""Sign and name of each ruling."""


def render_markdown(page: Page) -> str:
    """Return the page as Markdown."""
    return _render("page.md.j2", page=page, labels=LABELS)


def render_html(markdown: str) -> str:
    """Return the page, given as Markdown, as HTML."""
    return _render("page.html.j2", body=MarkdownIt().enable("table").render(markdown))


def _render(template: str, **values: Any) -> str:
    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.get_template(template).render(values)
