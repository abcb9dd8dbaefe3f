"""The page as HTML: one file, its pictures in it, without scripts; for a screen, light or dark, and
for paper."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Iterator, Sequence
from html import escape
from pathlib import Path

from rack.tools.console.tables import is_number
from rack.tools.lab.reproduction.sections.page import (
    Columns,
    Item,
    Listing,
    Page,
    PageClaim,
    PageSection,
    Plate,
    Ruling,
    Side,
    plain,
)

PAPER = (
    "J. L. Michaloski, T. E. Wheatley, R. Lumia: <i>Analysis of Computational Parallelism with a"
    " Concurrent Hierarchical Robot Control System</i>, NISTIR 90-4251, National Institute of"
    " Standards and Technology, March 1990"
)
TITLE = "A robot controller of 1990, reproduced"
MARKS = {
    Ruling.HOLDS: "✓",
    Ruling.BOUNDED: "≈",
    Ruling.CONTRADICTS: "↯",
    Ruling.UNTESTABLE: "\N{EN DASH}",
    Ruling.FAILS: "✗",
    Ruling.UNMADE: "…",
}
MEANINGS = {
    Ruling.HOLDS: "Prediction and measurement agree with the paper.",
    Ruling.BOUNDED: "It holds, with limits that the text names, of this machine or of the claim.",
    Ruling.CONTRADICTS: "What the paper says in one place excludes what it says in another.",
    Ruling.UNTESTABLE: "Machine, program or run lack what a test needs; the text says what.",
    Ruling.FAILS: "Prediction or measurement contradicts the paper.",
    Ruling.UNMADE: "Its experiments have not been made, or could not be finished.",
}
STYLE = """
:root { color-scheme: light dark; --ink: #1c1e21; --soft: #5b6470; --page: #fbfaf7; --card: #ffffff; --line: #dcd8cf;
  --quote: #f3efe6; --accent: #31579b; --good: #1d7a46; --fair: #8a6100; --odd: #7a3fa0; --bad: #b3261e;
  --none: #5b6470; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6e4df; --soft: #a5a9b0; --page: #16181b; --card: #1d2024;
  --line: #383c43; --quote: #24272c; --accent: #8fb2f0; --good: #6fce97; --fair: #e0b44c; --odd: #cf9cf2;
  --bad: #ff8a80; --none: #a5a9b0; } }
* { box-sizing: border-box; }
body { margin: 0 auto; max-width: 62rem; padding: 2.5rem 1.25rem 5rem; background: var(--page); color: var(--ink);
  font: 1.02rem/1.6 Charter, "Bitstream Charter", "Iowan Old Style", Georgia, "DejaVu Serif", serif; }
h1, h2, h3, h4, th, nav, .ruling, figcaption { font-family: system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
h1 { font-size: 2rem; line-height: 1.2; margin: 0 0 .6rem; }
h2 { font-size: 1.45rem; margin: 3.5rem 0 .6rem; padding-top: .6rem; border-top: 2px solid var(--ink); }
h3 { font-size: 1.1rem; margin: 0 0 .7rem; display: flex; gap: .8rem; justify-content: space-between;
  align-items: baseline; }
h4 { font-size: .78rem; letter-spacing: .06em; text-transform: uppercase; color: var(--soft); margin: 1.1rem 0 .3rem; }
p { margin: .5rem 0; } a { color: var(--accent); }
.lead { color: var(--soft); }
article { background: var(--card); border: 1px solid var(--line); border-radius: .5rem; padding: 1.1rem 1.3rem;
  margin: 1.3rem 0; }
blockquote { margin: .4rem 0; padding: .45rem .9rem; background: var(--quote); border-left: 3px solid var(--line);
  font-style: italic; }
.equation { text-align: center; font-size: 1.25rem; margin: 1rem 0; font-style: italic; }
.equation sub, .equation sup { font-size: .68em; font-style: normal; }
sub, sup { line-height: 0; }
.ruling { font-size: .78rem; font-weight: 600; white-space: nowrap; border: 1.5px solid; border-radius: 1rem;
  padding: .05rem .65rem; }
.why { border-top: 1px solid var(--line); padding-top: .6rem; margin-top: 1rem; }
.holds { color: var(--good); } .bounded { color: var(--fair); } .contradicts { color: var(--odd); }
.fails { color: var(--bad); } .untestable, .unmade { color: var(--none); }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .88rem; margin: .5rem 0; min-width: 40%; }
th, td { padding: .22rem .7rem .22rem 0; border-bottom: 1px solid var(--line); text-align: left; vertical-align: top; }
th { font-size: .78rem; color: var(--soft); font-weight: 600; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; }
td code { white-space: nowrap; }
.caption { font: .82rem system-ui, sans-serif; color: var(--soft); margin: -.2rem 0 .6rem; }
figure { margin: .8rem 0; }
figure img { display: block; width: 100%; background: #fff; border-radius: .3rem; padding: .3rem; }
figcaption { font-size: .82rem; color: var(--soft); padding-top: .3rem; }
pre { overflow-x: auto; background: var(--quote); padding: .7rem .9rem; border-radius: .3rem; font-size: .8rem;
  line-height: 1.35; margin: .5rem 0; }
code, pre { font-family: "DejaVu Sans Mono", "SF Mono", Consolas, monospace; } code { font-size: .86em; }
nav ul { list-style: none; padding-left: 1rem; margin: .2rem 0; } nav > ul { padding: 0; } nav { font-size: .9rem; }
nav .mark { display: inline-block; width: 1.3rem; font-weight: 700; }
@media print { body { max-width: none; padding: 0; font-size: 10pt; background: #fff; color: #000; }
  article { border: none; border-top: 1px solid #999; border-radius: 0; padding: .5rem 0; }
  figure, tr, blockquote, .equation { break-inside: avoid; } h2, h3, h4 { break-after: avoid; }
  pre { white-space: pre-wrap; } a { color: inherit; text-decoration: none; } @page { margin: 18mm 16mm; } }
"""


def html(page: Page, folder: Path) -> str:
    """Return the page as HTML; its pictures are read from `folder`."""
    body = "\n".join(_body(page, folder))
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{TITLE}</title>
<style>{STYLE}</style>
</head>
<body>
{body}
</body>
</html>
"""


def _body(page: Page, folder: Path) -> Iterator[str]:
    yield f"<h1>{TITLE}</h1>"
    yield f'<p class="lead">{PAPER}.</p>'
    yield from (f"<p>{line}</p>" for line in opening(page))
    yield from _table(rulings(page))
    yield from _contents(page)
    for section in page.sections:
        yield from _section(section, folder)
    yield '<h2 id="runs">The runs</h2>'
    yield from _table(Columns(("", ""), page.facts))


def opening(page: Page) -> Iterator[str]:
    """Yield the first paragraphs."""
    yield (
        "This page goes through the paper section by section. Each claim, equation and figure is"
        " given in the paper's words, followed by our prediction from the timing model, our"
        " measurement on real processes, and a ruling: the result of the comparisons listed with"
        " it. No number is written by hand: predictions"
        " are computed from the configs of this project's racks, measurements come from the runs"
        " listed at the end. Times are in ms unless a unit is given."
    )
    if odd := page.of(Ruling.CONTRADICTS):
        links = ", ".join(f'<a href="#{claim.name}">{claim.title}</a>' for claim in odd)
        yield f"Where the paper contradicts itself: {links}."


def rulings(page: Page) -> Columns:
    """Return the table of rulings, those that occur."""
    rows = [
        (f"{MARKS[ruling]} {ruling.value}", len(claims), MEANINGS[ruling])
        for ruling in Ruling
        if (claims := page.of(ruling))
    ]
    return Columns(("ruling", "claims", "meaning"), rows)


def _contents(page: Page) -> Iterator[str]:
    yield '<nav aria-label="contents"><h4>Contents</h4><ul>'
    for section in page.sections:
        yield f'<li><a href="#section-{section.name}">{heading(section)}</a><ul>'
        for claim in section.claims:
            ruling = claim.tested.ruling
            mark = (
                f'<span class="mark {ruling.name.lower()}"'
                f' title="{ruling.value}">{MARKS[ruling]}</span>'
            )
            yield f'<li>{mark}<a href="#{claim.name}">{claim.title}</a></li>'
        yield "</ul></li>"
    yield '<li><a href="#runs">The runs</a></li></ul></nav>'


def heading(section: PageSection) -> str:
    """Return a section's heading, with its number if it has one."""
    return f"{section.name} {section.title}" if section.name[0].isdigit() else section.title


def _section(section: PageSection, folder: Path) -> Iterator[str]:
    yield f'<section id="section-{section.name}">\n<h2>{heading(section)}</h2>'
    yield f"<p>{section.intro}</p>"
    for claim in section.claims:
        yield from _claim(claim, folder)
    yield "</section>"


def _claim(claim: PageClaim, folder: Path) -> Iterator[str]:
    ruling = claim.tested.ruling
    kind = ruling.name.lower()
    yield f'<article id="{claim.name}">'
    yield (
        f'<h3>{claim.title} <span class="ruling {kind}">{MARKS[ruling]} {ruling.value}</span></h3>'
    )
    yield f"<blockquote>{claim.quote}</blockquote>"
    if claim.equation:
        yield f'<p class="equation">{claim.equation}</p>'
    yield from _side("Predicted", claim.predicted, folder)
    yield from _side("Measured", claim.tested.measured, folder)
    yield (
        f'<p class="why"><b class="{kind}">{ruling.value.capitalize()}.</b>'
        f" {claim.tested.why}</p>\n</article>"
    )


def _side(name: str, side: Side, folder: Path) -> Iterator[str]:
    if side:
        yield f"<h4>{name}</h4>"
    for item in side:
        yield from _item(item, folder)


def _item(item: Item, folder: Path) -> Iterator[str]:
    match item:
        case str():
            yield f"<p>{item}</p>"
        case Columns():
            yield from _table(item)
        case Plate(path, caption):
            data = b64encode((folder / path).read_bytes()).decode()
            kind = {".svg": "svg+xml", ".png": "png"}[path.suffix]
            alt = escape(plain(caption))
            yield f'<figure><img alt="{alt}" src="data:image/{kind};base64,{data}">'
            yield f"<figcaption>{caption}</figcaption></figure>"
        case Listing(lines, caption):
            yield f"<pre>{escape(lines, quote=False)}</pre>"
            yield from _caption(caption)


def _table(table: Columns) -> Iterator[str]:
    kinds = []
    for _, *cells in zip(table.head, *table.cells, strict=True):
        is_numeric = bool(cells) and all(map(is_figure, cells))
        kinds.append(' class="number"' if is_numeric else "")
    yield '<div class="wide"><table>'
    if any(table.head):
        yield _row("th", table.head, kinds)
    for row in table.cells:
        yield _row("td", row, kinds)
    yield "</table></div>"
    yield from _caption(table.caption)


def _row(tag: str, cells: Sequence[str], kinds: Sequence[str]) -> str:
    filled = (f"<{tag}{kind}>{cell}</{tag}>" for cell, kind in zip(cells, kinds, strict=True))
    return f"<tr>{''.join(filled)}</tr>"


def _caption(words: str) -> Iterator[str]:
    if words:
        yield f'<p class="caption">{words}</p>'


def is_figure(cell: str) -> bool:
    """Return whether a cell holds a number, with a unit or a sign of comparison, or nothing."""
    return is_number(
        cell.removesuffix(" %").removesuffix(" ms").removesuffix(" us").removesuffix(" s")
    )
