"""The page as HTML and Markdown: whole by itself, and nothing of it lost."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

import pytest

from rack.tools.lab.reproduction.html import html
from rack.tools.lab.reproduction.markdown import markdown
from rack.tools.lab.reproduction.sections.page import (
    Assessment,
    Columns,
    Listing,
    Page,
    PageClaim,
    PageSection,
    Plate,
    Ruling,
    Side,
    code,
    plain,
    text,
)

PICTURE = '<svg xmlns="http://www.w3.org/2000/svg" width="8" height="8"/>'


@pytest.fixture
def page(tmp_path: Path) -> Page:
    (tmp_path / "pictures").mkdir()
    (tmp_path / "pictures" / "one.svg").write_text(PICTURE)
    measured: Side = [
        f"A value below {text('<limit>')}.",
        Columns(("of", "ms"), [("servo", "1.5"), (code("a | b"), 20), ("task", None)]),
        Plate(Path("pictures/one.svg"), "A picture of t<sub>exec</sub>."),
        Listing("R X W P | <U>"),
    ]
    claim = PageClaim(
        name="equation-3.8",
        title="Equation 3.8",
        quote="A plan must finish.",
        predicted=["So it is."],
        tested=Assessment(measured, Ruling.CONTRADICTS, "Both cannot be."),
        equation="t<sub>plan</sub> / d &lt; t<sub>residual</sub>",
    )
    return Page((PageSection("3.3", "Higher levels", "Of planners.", (claim,)),), (("cores", "2"),))


class Links(HTMLParser):
    """Collects everything that a browser would fetch or follow, anchors, and tags that are not
    closed."""

    def __init__(self) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.anchors: set[str] = set()
        self.open: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("src", "href", "srcset", "action", "data"):
                self.targets.append(value or "")
            if name == "id":
                self.anchors.add(value or "")
        if tag not in ("meta", "img"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def links_of(document: str) -> Links:
    links = Links()
    links.feed(document)
    return links


def test_html_fetches_nothing_and_every_link_leads_into_it(page: Page, tmp_path: Path) -> None:
    links = links_of(html(page, tmp_path))
    assert not links.open
    assert [target for target in links.targets if target.startswith("data:image/svg+xml;base64,")]
    assert {
        target[1:] for target in links.targets if not target.startswith("data:")
    } <= links.anchors
    assert "<script" not in html(page, tmp_path)
    assert not re.search(r"url\(|@import", html(page, tmp_path))


def test_html_is_made_for_paper_and_for_the_dark(page: Page, tmp_path: Path) -> None:
    document = html(page, tmp_path)
    assert "@media print" in document
    assert "prefers-color-scheme: dark" in document


def test_markdown_shows_pictures_next_to_it_and_keeps_tables_whole(
    page: Page, tmp_path: Path
) -> None:
    document = markdown(page)
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)", document)
    assert pictures == ["pictures/one.svg"]
    rows = [
        line
        for line in document.splitlines()
        if line.startswith("| ") and ("servo" in line or "a &#124; b" in line)
    ]
    assert len(rows) == 2
    assert all(row.count("|") == 3 for row in rows)


def test_both_forms_hold_the_same_words(page: Page, tmp_path: Path) -> None:
    for words in (
        "A plan must finish.",
        "So it is.",
        "Both cannot be.",
        "&lt;limit&gt;",
        Ruling.CONTRADICTS.value,
    ):
        assert words in html(page, tmp_path)
        assert words in markdown(page)


def test_data_are_plain_text(page: Page) -> None:
    (claim,) = page.document()["sections"][0]["claims"]
    assert claim["measured"][0] == "A value below <limit>."
    assert claim["measured"][1] == [
        {"of": "servo", "ms": "1.5"},
        {"of": "a | b", "ms": "20"},
        {"of": "task", "ms": "-"},
    ]
    assert plain("t<sub>i</sub><sup>2</sup> &minus; <i>x</i>") == "t_i^2 \N{MINUS SIGN} x"
