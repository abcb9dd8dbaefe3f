"""The whole reproduction: select and run the missing experiments, and write the page."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rack.tools.console.answer import Failure, convert_errors, write_file, write_json
from rack.tools.console.progress import Progress
from rack.tools.lab.reproduction.claims import SECTIONS
from rack.tools.lab.reproduction.experiments.experiment import (
    Experiment,
    StoredResult,
    Workshop,
    compute_program_checksum,
    describe_machine,
    load_result,
    run_and_store,
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
# Files of the page in its folder.
HTML = "index.html"
MARKDOWN = "README.md"
DATA = "paper.json"


def select_sections(names: Sequence[str]) -> list[Section[PaperClaim]]:
    """Return the sections with these names, or all if no name is given.

    Raises:
        Failure: If no section has one of the names.
    """
    known = {section.section: section for section in SECTIONS}
    if unknown := [name for name in names if name not in known]:
        raise Failure(f"--only {unknown[0]}: no such section; sections: {', '.join(known)}", 2)
    return [known[name] for name in names or known]


def list_experiments(sections: Sections) -> list[Experiment[Any]]:
    """Return the experiments of these sections without repetitions."""
    claims = (claim for section in sections for claim in section.claims)
    return list({each.name: each for claim in claims for each in claim.experiments}.values())


def reproduce_paper(wanted: Sections, workshop: Workshop, progress: Progress) -> Page:
    """Run the missing experiments of some sections, and write the page of all sections.

    Args:
        wanted: Sections whose experiments are run.
        workshop: Folder and settings for the experiments.
        progress: Shows each experiment.

    Returns:
        The page.
    """
    workshop.prepare()
    results: dict[str, StoredResult | str] = {
        experiment.name: result
        for experiment in list_experiments(SECTIONS)
        if (result := load_result(experiment, workshop.folder))
    }
    needed = [each for each in list_experiments(wanted) if each.name not in results]
    progress.set_total(sum(experiment.seconds for experiment in needed))
    for number, experiment in enumerate(needed, 1):
        progress.begin_run(f"{number} of {len(needed)}: {experiment.about}")
        try:
            with convert_errors():
                result = run_and_store(experiment, workshop)
        except Failure as error:
            results[experiment.name] = str(error)
            progress.end_run(experiment.seconds, "failed", [f"{experiment.name}: {error}"])
        else:
            results[experiment.name] = result
            progress.end_run(experiment.seconds, result.lacking or f"done in {result.took_s:.0f} s")
    return _write_page(workshop, results)


def _write_page(workshop: Workshop, results: dict[str, StoredResult | str]) -> Page:
    """Write the page into the folder in every form, and return it."""
    facts = {
        name: str(value)
        for name, value in (describe_machine() | {"program": compute_program_checksum()}).items()
    }
    for name, result in results.items():
        if isinstance(result, StoredResult):
            facts[name] = f"{result.made_at}, {result.took_s:g} s {result.lacking}"
    sections = tuple(
        Section(
            each.section, each.title, tuple(claim.judge_results(results) for claim in each.claims)
        )
        for each in SECTIONS
    )
    rulings = [claim.ruling for section in sections for claim in section.claims]
    page = Page(facts, {ruling: rulings.count(ruling) for ruling in LABELS}, sections)
    markdown = render_markdown(page)
    write_file(workshop.folder / MARKDOWN, markdown)
    write_file(workshop.folder / HTML, render_html(markdown))
    write_json(workshop.folder / DATA, page.to_document())
    return page


def has_succeeded(page: Page, wanted: Sections) -> bool:
    """Return True if every claim of these sections was tested and none failed."""
    names = [section.section for section in wanted]
    return not any(
        claim.ruling in (Ruling.FAILS, Ruling.UNMADE)
        for section in page.sections
        if section.section in names
        for claim in section.claims
    )


def summarize_page(page: Page, folder: Path) -> list[str]:
    """Summarise the page in a few lines for the terminal."""
    lines = [
        f"{LABELS[claim.ruling]}: {claim.title}"
        for section in page.sections
        for claim in section.claims
    ]
    counts = [f"{LABELS[ruling]}: {count}" for ruling, count in page.rulings.items() if count]
    return [*lines, "", ", ".join(counts), f"{folder}/{HTML}, {MARKDOWN}"]
