"""Figure 1 of the paper, drawn from a config: commands down, statuses up, a planner and an executor
in each level."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from html import escape

from rack.backplane.layout import Layout, MailboxSpec
from rack.levels.timing.rack import RackTiming

LEFT = 300
WIDE = 420
HIGH = 92
GAP = 84
TOP = 40
"""Place and size of a level, and the distance to the next one."""
SIDE = 250
"""Width of the boards next to the hierarchy."""
STYLE = (
    "text{font:13px system-ui,'DejaVu"
    " Sans',sans-serif;fill:#1c1e21}.small{font-size:11px;fill:#5b6470}"
    ".name{font-weight:600}.box{fill:#fff;stroke:#1c1e21;stroke-width:1.3}.part{fill:#eef2f8;stroke:#6b7686}"
    ".plan{fill:#e6f4ec;stroke:#5c8a6e}.line{fill:none;stroke:#31579b;stroke-width:1.6}.up{stroke:#8a6100}"
    ".aside{stroke:#8b93a0;stroke-dasharray:4 3}"
)
PAPER = '<rect width="100%" height="100%" fill="#fff"/>'
ARROW = (
    '<marker id="{0}" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7"'
    ' orient="auto">'
)
ARROW += '<path d="M0 0 8 4 0 8z" fill="{1}"/></marker>'


def between(layout: Layout, writer: str, reader: str) -> list[MailboxSpec]:
    """Return the mailboxes that one level's executor writes and the other's reads."""
    return [box for box in layout.mailboxes if box.writer == writer and reader in box.readers]


def flow_svg(rack: RackTiming, layout: Layout) -> str:
    """Return the information flow of a rack's first chain as SVG, with the boards next to it."""
    levels = rack.hierarchy.chains[0]
    others = [name for name in rack.boards if name not in levels]
    height = TOP + len(levels) * (HIGH + GAP) - GAP + 24
    drawn = [*_levels(rack, layout, levels), *_others(layout, levels, others)]
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 1000 {height}" role="img">'
    marks = "".join(
        ARROW.format(*mark) for mark in (("d", "#31579b"), ("u", "#8a6100"), ("a", "#8b93a0"))
    )
    return f"{head}<style>{STYLE}</style><defs>{marks}</defs>{PAPER}{''.join(drawn)}</svg>\n"


def _levels(rack: RackTiming, layout: Layout, levels: Sequence[str]) -> Iterator[str]:
    for at, name in enumerate(levels):
        board = rack.boards[name]
        y = TOP + at * (HIGH + GAP)
        rate = 1e9 / (board.every * rack.clock_ns)
        yield f'<rect class="box" x="{LEFT}" y="{y}" width="{WIDE}" height="{HIGH}" rx="6"/>'
        yield _text(LEFT + 12, y + 20, f"{name}, {rate:g} Hz", "name")
        yield f'<rect class="part" x="{LEFT + 232}" y="{y + 32}" width="172" height="46" rx="4"/>'
        yield _text(LEFT + 318, y + 52, "executor", "name", "middle")
        yield _text(LEFT + 318, y + 69, "runs every cycle", "small", "middle")
        if board.has_planner:
            yield (
                f'<rect class="part plan" x="{LEFT + 14}" y="{y + 32}" width="160" height="46"'
                ' rx="4"/>'
            )
            yield _text(LEFT + 94, y + 52, "planner", "name", "middle")
            place = "same processor" if board.coupling == "tight" else "board of its own"
            yield _text(LEFT + 94, y + 69, place, "small", "middle")
            yield _line(LEFT + 174, y + 55, LEFT + 230, y + 55, "line", "d")
            yield _text(LEFT + 202, y + 48, "plan", "small", "middle")
        if at + 1 < len(levels):
            yield from _arrows(layout, name, levels[at + 1], y + HIGH)


def _arrows(layout: Layout, upper: str, lower: str, y: int) -> Iterator[str]:
    """Yield the arrows from one level to the next, at the lower edge `y` of the upper one."""
    down = LEFT + 250
    up = LEFT + 382
    yield _line(down, y, down, y + GAP, "line", "d")
    yield _line(up, y + GAP, up, y, "line up", "u")
    for row, box in enumerate(between(layout, upper, lower)):
        yield _text(down - 10, y + 34 + 16 * row, f"{box.name}: {box.message}", "small", "end")
    for row, box in enumerate(between(layout, lower, upper)):
        yield _text(up + 10, y + 34 + 16 * row, f"{box.name}: {box.message}", "small")


def _others(layout: Layout, levels: Sequence[str], others: Sequence[str]) -> Iterator[str]:
    """Yield the boards next to the hierarchy, with the levels that they read and that read them."""
    for number, name in enumerate(others):
        y = TOP + (2 * number + 1) * (HIGH + GAP)
        sources = [level for level in levels if between(layout, level, name)]
        own = [box for box in layout.mailboxes if box.writer == name]
        readers = sorted(
            {reader.partition(".")[0] for box in own for reader in box.readers} - {name}
        )
        middle = y + HIGH // 2
        yield f'<rect class="box" x="14" y="{y}" width="{SIDE}" height="{HIGH}" rx="6"/>'
        yield _text(26, y + 22, name, "name")
        yield _text(26, y + 46, f"reads {', '.join(sources) or 'none of the levels'}", "small")
        yield _text(26, y + 64, f"read by {', '.join(readers) or 'nobody'}", "small")
        for at, level in enumerate(levels):
            edge = TOP + at * (HIGH + GAP) + HIGH // 2 + 30
            if level in readers:
                yield _line(14 + SIDE, middle, LEFT - 2, edge - 12, "line aside", "a")
            if level in sources:
                yield _line(LEFT, edge + 6, 16 + SIDE, middle + 12, "line aside", "a")


def _line(x1: float, y1: float, x2: float, y2: float, kind: str, mark: str) -> str:
    return f'<path class="{kind}" d="M{x1} {y1} {x2} {y2}" marker-end="url(#{mark})"/>'


def _text(x: float, y: float, words: str, kind: str, anchor: str = "start") -> str:
    return f'<text class="{kind}" x="{x}" y="{y}" text-anchor="{anchor}">{escape(words)}</text>'
