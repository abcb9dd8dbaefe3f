"""The whole reproduction: which experiments are still to be made, making them, and writing the
page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from rack.backplane.errors import BackplaneError
from rack.backplane.json_text import encode_json
from rack.boards.errors import BoardError
from rack.levels.errors import LevelError
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.reproduction.experiments.experiment import (
    KEPT,
    Experiment,
    Kept,
    Workshop,
    kept,
    machine,
    made,
    program,
)
from rack.tools.lab.reproduction.html import MARKS, html
from rack.tools.lab.reproduction.markdown import markdown
from rack.tools.lab.reproduction.sections import (
    application,
    comparison,
    conclusion,
    gantt,
    model,
    opening,
    timing,
)
from rack.tools.lab.reproduction.sections.page import Chapter, Page, Ruling, plain, text

CHAPTERS: tuple[Chapter, ...] = (
    opening.ABSTRACT,
    opening.INTRODUCTION,
    model.CHAPTER,
    timing.SOFT,
    timing.RESPONSE,
    timing.LOW,
    timing.HIGH,
    gantt.CHAPTER,
    application.CHAPTER,
    comparison.CHAPTER,
    conclusion.CHAPTER,
)
"""The sections of the page, in the paper's order."""
HTML = "index.html"
MARKDOWN = "README.md"
DATA = "paper.json"
"""Forms of the page, in its folder."""
PROJECT = (BackplaneError, BoardError, LevelError, Failure)
"""Errors that the project raises on purpose: one experiment fails, the others go on."""


def chapters_named(names: Sequence[str]) -> list[Chapter]:
    """Return the chapters of these names, all for none. Raises `Failure` for a name that no chapter
    has."""
    known = {chapter.name: chapter for chapter in CHAPTERS}
    if unknown := [name for name in names if name not in known]:
        raise Failure(f"--only {unknown[0]}: no such section; permitted: {', '.join(known)}", 2)
    return [known[name] for name in names] if names else list(CHAPTERS)


def forget(wanted: Sequence[Chapter], folder: Path) -> None:
    """Remove what is kept for these chapters, so that it is made again."""
    for experiment in experiments(wanted):
        (folder / KEPT / f"{experiment.name}.json").unlink(missing_ok=True)


def reproduce(wanted: Sequence[Chapter], workshop: Workshop, progress: Progress) -> Page:
    """Make what is still to be made for these chapters; return the page of all, written into the
    folder."""
    workshop.prepare()
    results: dict[str, Kept | str] = {}
    for experiment in experiments(CHAPTERS):
        if result := kept(experiment, workshop.folder):
            results[experiment.name] = result
    needed = [one for one in experiments(wanted) if one.name not in results]
    if needed:
        progress.total(sum(one.seconds for one in needed))
    for number, experiment in enumerate(needed, 1):
        progress.begin(f"{number} of {len(needed)}: {experiment.about}")
        try:
            result = made(experiment, workshop)
        except PROJECT as error:
            results[experiment.name] = str(error)
            progress.end(experiment.seconds, "failed", [f"{experiment.name}: {error}"])
        else:
            results[experiment.name] = result
            done = f"done in {result.took_s:.0f} s"
            progress.end(experiment.seconds, result.lacking or done)
    return write(workshop, results)


def experiments(chapters: Sequence[Chapter]) -> list[Experiment[Any]]:
    """Return the experiments of these chapters, each once."""
    statements = [statement for chapter in chapters for statement in chapter.statements]
    return list({one.name: one for each in statements for one in each.experiments}.values())


def write(workshop: Workshop, results: dict[str, Kept | str]) -> Page:
    """Write the page into the folder, as HTML, Markdown and data, and return it."""
    sections = tuple(chapter.section(workshop, results) for chapter in CHAPTERS)
    page = Page(sections, tuple(_facts(results)))
    documents = {
        HTML: html(page, workshop.folder),
        MARKDOWN: markdown(page),
        DATA: encode_json(page.document(), indent=2) + "\n",
    }
    for name, document in documents.items():
        (workshop.folder / name).write_text(document, encoding="utf-8")
    return page


def _facts(results: dict[str, Kept | str]) -> Iterator[tuple[str, str]]:
    """Yield what the page says of the machine, the program and the runs."""
    found = {name: one for name, one in results.items() if isinstance(one, Kept)}
    took_s = sum(one.took_s for one in found.values())
    for name, value in machine().items():
        yield name, text(value)
    yield "program", program()
    yield "experiments", f"{len(found)} of {len(experiments(CHAPTERS))}, {took_s:.0f} s"
    for name, one in found.items():
        lacking = f"; {text(one.lacking)}" if one.lacking else ""
        yield f"experiment {name}", f"{one.made_at}, {one.took_s:g} s{lacking}"


def worked(page: Page, wanted: Sequence[Chapter]) -> bool:
    """Return whether every claim of these chapters was tested, and none that should hold failed."""
    names = {chapter.name for chapter in wanted}
    claims = [
        claim for section in page.sections if section.name in names for claim in section.claims
    ]
    return not any(claim.tested.ruling.is_failure for claim in claims)


def summary(page: Page, folder: Path) -> list[str]:
    """Return the page in a few lines for the terminal."""
    lines = [
        f"{MARKS[claim.tested.ruling]} {plain(claim.title)}: {claim.tested.ruling.value}"
        for claim in page.claims
    ]
    counted = [f"{len(claims)} {ruling.value}" for ruling in Ruling if (claims := page.of(ruling))]
    return [*lines, "", ", ".join(counted), f"{folder}/{HTML}, {MARKDOWN}"]


def document(page: Page, folder: Path, is_good: bool) -> dict[str, Any]:
    """Return the answer to --json."""
    return {"folder": str(folder), "worked": is_good, **page.document()}
