"""The whole reproduction: which experiments are still to be made, making them, and writing the
page.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rack.tools.console.answer import Failure, as_failure, write_file, write_json
from rack.tools.console.progress import Progress
from rack.tools.lab.reproduction.claims import SECTIONS
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
from rack.tools.lab.reproduction.page import (
    LABELS,
    Page,
    PaperClaim,
    Section,
    render_html,
    render_markdown,
)
from rack.tools.lab.reproduction.verdict import Ruling

Sections = Sequence[Section[PaperClaim]]
HTML = "index.html"
MARKDOWN = "README.md"
DATA = "paper.json"
"""Forms of the page, in its folder."""


def select_sections(names: Sequence[str]) -> list[Section[PaperClaim]]:
    """Return the sections of these names, all for none.

    Raises:
        Failure: No section has a name.
    """
    known = {section.section: section for section in SECTIONS}
    if unknown := [name for name in names if name not in known]:
        raise Failure(f"--only {unknown[0]}: no such section; permitted: {', '.join(known)}", 2)
    return [known[name] for name in names or known]


def list_experiments(sections: Sections) -> list[Experiment[Any]]:
    """Return the experiments of these sections, each once."""
    claims = (claim for section in sections for claim in section.claims)
    return list({one.name: one for claim in claims for one in claim.experiments}.values())


def reproduce(
    wanted: Sections,
    workshop: Workshop,
    progress: Progress,
    again: bool = False,
) -> Page:
    """Make what is still to be made for these sections and write the page of all into the folder.

    Args:
        wanted: The sections whose experiments are made.
        workshop: Where they are made.
        progress: What shows how far that is.
        again: Whether finished experiments of these sections are repeated.

    Returns:
        The page.
    """
    workshop.prepare()
    if again:
        for one in list_experiments(wanted):
            (workshop.folder / KEPT / f"{one.name}.json").unlink(missing_ok=True)
    results: dict[str, Kept | str] = {
        one.name: result
        for one in list_experiments(SECTIONS)
        if (result := kept(one, workshop.folder))
    }
    needed = [one for one in list_experiments(wanted) if one.name not in results]
    progress.total(sum(one.seconds for one in needed))
    for number, one in enumerate(needed, 1):
        progress.begin(f"{number} of {len(needed)}: {one.about}")
        try:
            with as_failure():
                result = made(one, workshop)
        except Failure as error:
            results[one.name] = str(error)
            progress.end(one.seconds, "failed", [f"{one.name}: {error}"])
        else:
            results[one.name] = result
            progress.end(one.seconds, result.lacking or f"done in {result.took_s:.0f} s")
    return _write(workshop, results)


def _write(workshop: Workshop, results: dict[str, Kept | str]) -> Page:
    """Write the page into the folder in every form, and return it."""
    facts = {name: str(value) for name, value in (machine() | {"program": program()}).items()}
    for name, one in results.items():
        if isinstance(one, Kept):
            facts[name] = f"{one.made_at}, {one.took_s:g} s {one.lacking}"
    sections = tuple(
        Section(one.section, one.title, tuple(claim.judge_by(results) for claim in one.claims))
        for one in SECTIONS
    )
    rulings = [claim.ruling for section in sections for claim in section.claims]
    page = Page(facts, {ruling: rulings.count(ruling) for ruling in LABELS}, sections)
    markdown = render_markdown(page)
    write_file(workshop.folder / MARKDOWN, markdown)
    write_file(workshop.folder / HTML, render_html(markdown))
    write_json(workshop.folder / DATA, page.document())
    return page


def has_worked(page: Page, wanted: Sections) -> bool:
    """Return whether every claim of these sections was tested, and none that should hold failed."""
    names = [section.section for section in wanted]
    return not any(
        claim.ruling in (Ruling.FAILS, Ruling.UNMADE)
        for section in page.sections
        if section.section in names
        for claim in section.claims
    )


def summarize(page: Page, folder: Path) -> list[str]:
    """Return the page in a few lines for the terminal."""
    lines = [
        f"{LABELS[claim.ruling]}: {claim.title}"
        for section in page.sections
        for claim in section.claims
    ]
    counts = [f"{LABELS[ruling]}: {count}" for ruling, count in page.rulings.items() if count]
    return [*lines, "", ", ".join(counts), f"{folder}/{HTML}, {MARKDOWN}"]
