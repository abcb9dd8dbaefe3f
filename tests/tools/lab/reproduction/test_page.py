"""The page as HTML, Markdown and data is self-contained and complete."""

from __future__ import annotations

import json
import re
from html.parser import HTMLParser

from rack.tools.lab.reproduction.page import (
    LABELS,
    Evidence,
    JudgedClaim,
    Page,
    Section,
    render_html,
    render_markdown,
)
from rack.tools.lab.reproduction.verdict import Ruling, compare_value

CLAIM = JudgedClaim(
    "equation-3.8",
    "Equation 3.8",
    "A plan must finish.",
    (Evidence("rack check fig3 --set a=1", text="R X W P | <U>"),),
    (
        Evidence(text="R X | W"),
        Evidence(checks=(compare_value("servo: t_plan < R_i", 1.5, "<", 1.0),)),
    ),
    Ruling.CONTRADICTS,
    "Both cannot be <so>.",
)
PAGE = Page(
    {"cores": "2"},
    {Ruling.CONTRADICTS: 1, Ruling.HOLDS: 0},
    (Section("3.3", "Higher levels", (CLAIM,)),),
)


class Links(HTMLParser):
    """Collects links, anchors, texts and unclosed tags of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.anchors: set[str] = set()
        self.open: list[str] = []
        self.texts: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if name in ("src", "href", "srcset", "action", "data"):
                self.targets.append(value or "")
            if name == "id":
                self.anchors.add(value or "")
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in ("img", "br"):
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.texts.append(data.strip())


def test_html_fetches_nothing_and_holds_every_word() -> None:
    document = render_html(render_markdown(PAGE))
    links = Links()
    links.feed(document)
    assert not links.open
    assert all(target.startswith("#") for target in links.targets)
    assert (
        {target[1:] for target in links.targets}
        == {"equation-3.8", "section-3.3", "runs"}
        == links.anchors
    )
    assert not re.search(r"<script|url\(|@import", document)
    assert "@media print" in document
    assert "color-scheme: light dark" in document
    assert {
        *("A plan must finish.", "Both cannot be <so>.", "R X W P | <U>", "R X | W", "NO"),
        *("servo: t_plan < R_i", "rack check fig3 --set a=1"),
        f"Equation 3.8: {LABELS[Ruling.CONTRADICTS]}",
    } <= set(links.texts)


def test_markdown_keeps_charts_and_tables_whole() -> None:
    document = render_markdown(PAGE)
    assert "**Measured**\n\n```text\nR X | W\n```" in document
    assert "| servo: t_plan &lt; R_i | 1.5 | &lt; 1 | NO |" in document.splitlines()
    assert "- [3.3 Higher levels](#section-3.3)\n  - ↯ [Equation 3.8](#equation-3.8)" in document


def test_the_page_converts_to_plain_data() -> None:
    data = json.loads(json.dumps(PAGE.to_document()))
    assert (data["facts"], data["rulings"]) == ({"cores": "2"}, {"contradicts": 1, "holds": 0})
    (section,) = data["sections"]
    (claim,) = section["claims"]
    assert (section["section"], claim["claim"]) == ("3.3", "equation-3.8")
    assert claim["ruling"] == "contradicts"
    (check,) = claim["measured"][1]["checks"]
    assert check == {"compared": "servo: t_plan < R_i", "measured": 1.5, "sign": "<"} | {
        "demanded": 1.0,
        "met": False,
    }
