"""A claim of the paper before it is judged, and how it becomes a claim of the page."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from rack.tools.lab.reproduction.experiments.experiment import (
    Document,
    Experiment,
    Found,
    Kept,
    Workshop,
)
from rack.tools.lab.reproduction.sections.page import (
    Assessment,
    PageClaim,
    PageSection,
    Ruling,
    Side,
    text,
)

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
class Findings:
    """What experiments have found, by their names, and where pictures of it are drawn."""

    found: Mapping[str, Document]
    workshop: Workshop

    def of(self, experiment: Experiment[Found]) -> Found:
        """Return what an experiment has found."""
        return experiment.record(self.found[experiment.name])


@dataclass(frozen=True)
class Statement:
    """A claim of the paper by its name, with the experiments that it rests on.

    `predicted` computes our side from configs alone, and may draw; `tested` judges what the
    experiments have found.
    """

    name: str
    experiments: tuple[Experiment[Any], ...]
    predicted: Callable[[Workshop], Side]
    tested: Callable[[Findings], Assessment]

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
        return self.tested(Findings(found, workshop))


@dataclass(frozen=True)
class Chapter:
    """A section of the paper with its claims; `name` is its number, as in "3.1", or "abstract"."""

    name: str
    statements: tuple[Statement, ...]

    def section(self, workshop: Workshop, results: Mapping[str, Kept | str]) -> PageSection:
        """Return the section with every claim judged."""
        claims = tuple(statement.claim(workshop, results) for statement in self.statements)
        return PageSection(self.name, claims=claims, **_texts("section", self.name))
