"""The kinds of faults as a list, which is also the end of the help of `rack inject`."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any

from typer.core import TyperCommand

from rack.tools.console.tables import table


class KindsCommand(TyperCommand):
    """A command whose help ends with the kinds of faults, which are imported only when it is asked for."""

    def get_help(self, ctx: Any) -> str:
        """Return the help."""
        from rack.tools.console.tables import terminal_width

        return "\n".join([super().get_help(ctx), "", "Kinds:", *kinds_text(terminal_width())])


def kinds_text(width: int | None = None) -> Iterator[str]:
    """Yield the kinds as a table, and their parameters as another; with a width they fit into it."""
    from rack.boards.faults.kinds import KINDS

    rows = [[kind.name, kind.means, kind.bound, _remarks(kind.realtime, kind.once)] for kind in KINDS]
    yield from table(["kind", "what happens", "found within", ""], rows, width)
    yield ""
    numbers = [
        [
            kind.name,
            p.name,
            p.unit,
            "none" if p.default is None else f"{p.default:g}",
            f"{p.least:g} to {p.most:g}",
            p.meaning,
        ]
        for kind in KINDS
        for p in kind.parameters
    ]
    yield from table(["kind", "parameter", "unit", "default", "range", "meaning"], numbers, width)


def _remarks(realtime: bool, once: bool) -> str:
    return ", ".join([*(["real time only"] if realtime else []), *(["strikes once"] if once else [])])


def kinds_document() -> list[dict[str, Any]]:
    """Return the kinds as plain data."""
    from rack.boards.faults.kinds import KINDS

    return [{**asdict(kind), "seen_as": [alarm.name.lower() for alarm in kind.seen_as]} for kind in KINDS]
