"""The page with the paper's claims, as data, as Markdown and as HTML.

Each claim has predictions, measurements and a ruling.
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
from rack.tools.lab.reproduction.experiments.experiment import (
    ChartedRecord,
    Experiment,
    StoredResult,
)
from rack.tools.lab.reproduction.verdict import Check, ClaimVerdict, Ruling, describe_unmet


@dataclass(frozen=True)
class Evidence:
    """One piece of evidence for a claim: comparisons, or text of fixed width.

    Attributes:
        source: Command that produces it.
        checks: The comparisons.
        text: The text.
    """

    source: str = ""
    checks: tuple[Check, ...] = ()
    text: str = ""


@dataclass(frozen=True)
class JudgedClaim:
    """A claim on the page with its ruling.

    Attributes:
        claim: Anchor on the page.
        title: Heading.
        quote: Sentence of the paper.
        predicted: Evidence from configs alone.
        measured: Evidence from experiments.
        ruling: The ruling.
        why: Reason for the ruling, or the comparisons that are not met.
    """

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
        name: Anchor on the page.
        title: Heading.
        quote: Sentence of the paper.
        why: Reason for the ruling if every comparison is met.
        experiments: Experiments whose records are the arguments of `judge`, in this order.
        judge: Rule of the claim.
        predict: Returns the evidence that follows from configs alone.
    """

    name: str
    title: str
    quote: str
    why: str
    experiments: tuple[Experiment[Any], ...]
    judge: Callable[..., ClaimVerdict]
    predict: Callable[[], tuple[Evidence, ...]] = lambda: ()

    def judge_results(self, results: Mapping[str, StoredResult | str]) -> JudgedClaim:
        """Apply the rule of the claim to the results of its experiments.

        Args:
            results: Dictionary from the name of each experiment to its result, or to the reason why
                it has none.
        """
        unruled = JudgedClaim(self.name, self.title, self.quote, self.predict())
        records = []
        for experiment in self.experiments:
            result = results.get(experiment.name, "not run yet")
            if isinstance(result, str):
                return replace(unruled, why=f"{experiment.name}: {result}")
            if result.lacking:
                return replace(unruled, ruling=Ruling.UNTESTABLE, why=result.lacking)
            records.append(experiment.parse_record(result.found))
        verdict = self.judge(*records)
        charts = [Evidence(text=run.chart) for run in records if isinstance(run, ChartedRecord)]
        return replace(
            unruled,
            ruling=verdict.ruling,
            why=describe_unmet(verdict.checks) or self.why,
            measured=(*charts, Evidence(checks=verdict.checks)),
        )


C = TypeVar("C")


@dataclass(frozen=True)
class Section(Generic[C]):
    """A section of the paper with its claims, numbered as in "3.1", or "abstract"."""

    section: str
    title: str
    claims: tuple[C, ...]


@dataclass(frozen=True)
class Page:
    """The whole page. The facts describe the machine and the runs."""

    facts: dict[str, str]
    rulings: dict[Ruling, int]
    sections: tuple[Section[JudgedClaim], ...]

    def to_document(self) -> Document:
        """Convert the page to plain data."""
        return dict(TypeAdapter(Page).dump_python(self, mode="json"))


LABELS = {
    Ruling.HOLDS: "✓ holds",
    Ruling.BOUNDED: "≈ holds here, within bounds",
    Ruling.CONTRADICTS: "↯ the paper contradicts itself",
    Ruling.UNTESTABLE: "∅ not testable here",
    Ruling.FAILS: "✗ does not hold here",
    Ruling.UNMADE: "… not run yet",
}
"""Symbol and label of each ruling."""


def render_markdown(page: Page) -> str:
    """Render the page as Markdown."""
    return _render_template("page.md.j2", page=page, labels=LABELS)


def render_html(markdown: str) -> str:
    """Render the Markdown of the page as HTML."""
    return _render_template("page.html.j2", body=MarkdownIt().enable("table").render(markdown))


def _render_template(template: str, **values: Any) -> str:
    """Render a template of this folder."""
    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True, lstrip_blocks=True)
    return environment.get_template(template).render(values)
