"""The whole reproduction: which experiments are still to be made, making them, and writing the
page."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rack.backplane.errors import BackplaneError
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
from rack.tools.lab.reproduction.html import MARKS, html, rulings
from rack.tools.lab.reproduction.markdown import markdown
from rack.tools.lab.reproduction.sections import (
    application,
    comparison,
    conclusion,
    gantt,
    model,
    opening,
    time,
    timing,
)
from rack.tools.lab.reproduction.sections.page import Page, plain, text
from rack.tools.lab.reproduction.sections.statement import Chapter

CHAPTERS: tuple[Chapter, ...] = (
    opening.ABSTRACT,
    opening.INTRODUCTION,
    model.CHAPTER,
    time.CHAPTER,
    timing.RESPONSE,
    timing.LOW,
    timing.HIGH,
    gantt.CHAPTER,
    application.CHAPTER,
    comparison.CHAPTER,
    conclusion.CHAPTER,
)
"""The sections of the page, in the paper's order."""
FILES = ("index.html", "README.md", "paper.json")
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
    for one in experiments(wanted):
        (folder / KEPT / f"{one.name}.json").unlink(missing_ok=True)


def reproduce(wanted: Sequence[Chapter], workshop: Workshop, progress: Progress) -> Page:
    """Make what is still to be made for these chapters; return the page of all, written into the
    folder."""
    workshop.prepare()
    results = {
        one.name: found for one in experiments(CHAPTERS) if (found := kept(one, workshop.folder))
    }
    needed = [one for one in experiments(wanted) if one.name not in results]
    reasons = _make(needed, workshop, progress, results)
    return write(workshop, {**results, **reasons})


def experiments(chapters: Sequence[Chapter]) -> list[Experiment[Any]]:
    """Return the experiments of these chapters, each once."""
    return list({one.name: one for chapter in chapters for one in chapter.experiments}.values())


def _make(
    needed: Sequence[Experiment[Any]],
    workshop: Workshop,
    progress: Progress,
    results: dict[str, Kept],
) -> dict[str, str]:
    """Make experiments, add their results, and return why others could not be made, by name."""
    reasons = {}
    if needed:
        progress.total(sum(one.seconds for one in needed))
    for number, one in enumerate(needed, 1):
        progress.begin(f"{number} of {len(needed)}: {one.about}")
        try:
            results[one.name] = found = made(one, workshop)
            progress.end(one.seconds, found.lacking or f"done in {found.took_s:.0f} s")
        except PROJECT as error:
            reasons[one.name] = str(error)
            progress.end(one.seconds, "failed", [f"{one.name}: {error}"])
    return reasons


def write(workshop: Workshop, results: dict[str, Kept | str]) -> Page:
    """Write the page into the folder, as HTML, Markdown and data, and return it."""
    sections = tuple(chapter.section(workshop, results) for chapter in CHAPTERS)
    page = Page(sections, tuple(_facts(results)))
    documents = (
        html(page, workshop.folder),
        markdown(page),
        json.dumps(page.document(), indent=2) + "\n",
    )
    for name, document in zip(FILES, documents, strict=True):
        (workshop.folder / name).write_text(document, encoding="utf-8")
    return page


def _facts(results: dict[str, Kept | str]) -> list[tuple[str, str]]:
    here = machine()
    libraries = ", ".join(f"{name} {number}" for name, number in here["libraries"].items())
    found = [one for one in results.values() if isinstance(one, Kept)]
    facts = [(name, text(value)) for name, value in here.items() if name != "libraries"]
    facts += [("libraries", libraries), ("program", program())]
    facts += [
        (
            "experiments",
            f"{len(found)} of {len(experiments(CHAPTERS))}, {sum(f.took_s for f in found):.0f} s",
        )
    ]
    rows = [
        (
            f"experiment {name}",
            f"{one.made_at}, {one.took_s:g} s{f'; {text(one.lacking)}' if one.lacking else ''}",
        )
        for name, one in results.items()
        if isinstance(one, Kept)
    ]
    return [*facts, *rows]


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
    counted = ", ".join(f"{count} {ruling[2:]}" for ruling, count, _ in rulings(page).rows)
    return [*lines, "", counted, f"{folder}/{FILES[0]}, {FILES[1]}"]


def document(page: Page, folder: Path, is_good: bool) -> dict[str, Any]:
    """Return the answer to --json."""
    return {"folder": str(folder), "worked": is_good, **page.document()}
