"""The page as Markdown, as GitHub shows it, with its pictures next to it."""

from __future__ import annotations

from collections.abc import Iterator

from rack.tools.console.tables import markdown_table
from rack.tools.lab.reproduction.html import MARKS, PAPER, TITLE, heading, opening, rulings
from rack.tools.lab.reproduction.sections.page import (
    Columns,
    Item,
    Listing,
    Page,
    PageClaim,
    Plate,
    Side,
    plain,
)


def markdown(page: Page) -> str:
    """Return the page as Markdown; pictures are linked by their paths within its folder."""
    return "\n".join(_lines(page)) + "\n"


def _lines(page: Page) -> Iterator[str]:
    yield from (f"# {TITLE}", "", f"{PAPER}.", "")
    for line in opening(page):
        yield from (line, "")
    yield from _table(rulings(page))
    yield from ("## Contents", "")
    for section in page.sections:
        yield f"- [{heading(section)}](#section-{section.name})"
        for claim in section.claims:
            yield f"  - {MARKS[claim.tested.ruling]} [{claim.title}](#{claim.name})"
    yield from ("- [The runs](#runs)", "")
    for section in page.sections:
        yield from (
            f'<a id="section-{section.name}"></a>',
            "",
            f"## {heading(section)}",
            "",
            section.intro,
            "",
        )
        for claim in section.claims:
            yield from _claim(claim)
    yield from ('<a id="runs"></a>', "", "## The runs", "")
    yield from _table(Columns(("fact", "value"), page.facts))


def _claim(claim: PageClaim) -> Iterator[str]:
    ruling = claim.tested.ruling
    yield from (
        f'<a id="{claim.name}"></a>',
        "",
        f"### {claim.title}: {MARKS[ruling]} {ruling.value}",
        "",
    )
    yield from (f"> {claim.quote}", "")
    if claim.equation:
        yield from (f'<p align="center"><b>{claim.equation}</b></p>', "")
    yield from _side("Predicted", claim.predicted)
    yield from _side("Measured", claim.tested.measured)
    yield from (f"**{ruling.value.capitalize()}.** {claim.tested.why}", "")


def _side(name: str, side: Side) -> Iterator[str]:
    if side:
        yield from (f"**{name}**", "")
    for item in side:
        yield from _item(item)


def _item(item: Item) -> Iterator[str]:
    match item:
        case str():
            yield from (item, "")
        case Columns():
            yield from _table(item)
        case Plate(path, caption):
            alt = plain(caption).replace("[", "(").replace("]", ")")
            yield from (f"![{alt}]({path})", "", f"<sub>{caption}</sub>", "")
        case Listing(lines, caption):
            yield from ("```text", lines, "```", "")
            if caption:
                yield from (f"<sub>{caption}</sub>", "")


def _table(table: Columns) -> Iterator[str]:
    if table.caption:
        yield from (table.caption, "")
    # GitHub shows no table without a head.
    head = [cell or " " for cell in table.head]
    rows = [[cell.replace("|", "&#124;") for cell in row] for row in table.cells]
    yield from markdown_table(head, rows)
    yield ""
