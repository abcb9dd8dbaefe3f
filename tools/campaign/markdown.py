"""A campaign as text for people: campaign.md."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

Report = dict[str, Any]
SHOWN = 30
"""Shortfalls that the text shows; campaign.json has them all."""
KINDS_HEAD = [
    *("kind", "injected", "detected", "in bound", "cycles median", "max", "ticks median", "max", "bound, ticks"),
    *("ms median", "max", "recovery median, ms", "max", "task done", "reactions"),
]


def markdown(report: Report) -> str:
    """Return campaign.md of a campaign's document."""
    return "\n".join(_lines(report)) + "\n"


def _lines(report: Report) -> Iterator[str]:
    summary = report["summary"]
    verdict = "falls short" if report["shortfalls"] else "as it must be"
    yield f"# Campaign on {report['config']}, seed {report['seed']}: {verdict}"
    yield ""
    yield (
        f"{summary['trials']} trials, {' and '.join(dict.fromkeys(report['modes']))}, in {report['wall_s']:.0f} s on "
        f"{report['machine']['cores']} cores, Linux {report['machine']['kernel']}."
        f"{' Interrupted: this is what was done until then.' if report['interrupted'] else ''}"
    )
    yield from (f"- {note}" for note in report["machine"]["notes"])
    yield ""
    yield from table(["", ""], [[name, str(value)] for name, value in _summary(summary)])
    if report["by_kind"]:
        yield from ("", "## Faults by kind", "")
        yield from table(KINDS_HEAD, [_kind_row(kind, figures) for kind, figures in report["by_kind"].items()])
        yield from ("", "A cycle is the one of the task concerned, a planner's its time slice; a tick is the clock's.")
    yield from _faultless(report["faultless"])
    yield from _sizes(report["sizes"])
    yield from _shortfalls(report["shortfalls"])


def _summary(summary: Report) -> Iterator[tuple[str, Any]]:
    yield "faults drawn", f"{summary['drawn']}, of which {summary['not_struck']} did not strike"
    yield "injected", summary["injected"]
    yield "detected", summary["detected"]
    yield "within the bound", summary["within_bound"]
    yield "deaths seen at the Rack later than 5 ms", summary["late_at_rack"]
    yield "recovered from", summary["recovered"]
    ends = [f"{summary[key]} {name}" for key, name in _ENDS if summary[key]]
    yield "trials ended", ", ".join(ends) or "none"
    yield "limits violated", f"{summary['limits_violated']} (in any substep of any run)"
    yield "touches", summary["touches"]
    yield "left behind", f"{summary['left_behind']} (processes, segments)"
    yield "unexplained detections", summary["unexplained"]
    if summary["faultless_s"]:
        rate = f"{summary['false_trips_per_hour']:g} an hour"
        yield "false trips", f"{summary['false_trips']} in {summary['faultless_s']:g} s: {rate}"


_ENDS = (
    ("tasks_done", "task done"),
    ("safely_stopped", "safely stopped"),
    ("not_armed", "not armed, as it must be"),
    ("neither", "neither"),
)


def _kind_row(kind: str, figures: Report) -> list[str]:
    bound = figures["bound_ticks"]
    spans = "-" if bound is None else "-".join(dict.fromkeys(str(bound[key]) for key in ("least", "most")))
    return [
        kind,
        *(str(figures[key]) for key in ("injected", "detected", "within_bound")),
        *_spread(figures["cycles"]),
        *_spread(figures["ticks"]),
        spans,
        *_spread(figures["ms"]),
        *_spread(figures["recovery_ms"]),
        f"{figures['tasks_done']} of {figures['trials']}",
        ", ".join(figures["reactions"]) or "-",
    ]


def _spread(values: Report | None) -> tuple[str, str]:
    return ("-", "-") if values is None else (f"{values['median']:.4g}", f"{values['max']:.4g}")


def _faultless(parts: list[Report]) -> Iterator[str]:
    if not parts:
        return
    yield from ("", "## Faultless, in real time", "")
    rows = [
        [
            f"beside {part['load']} busy processes" if part["load"] else "alone",
            f"{part['seconds']:.0f}",
            str(part["trips"]),
            "-" if part["trips_per_hour"] is None else f"{part['trips_per_hour']:g}",
            ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in part["misses"].items()) or "none",
        ]
        for part in parts
    ]
    yield from table(["", "s", "false trips", "an hour", "misses, which trip nothing"], rows)


def _sizes(sizes: Report) -> Iterator[str]:
    for kind, found in sizes.items():
        yield from ("", f"## {kind}: size against delay", "", f"Must be seen from {found['judged_from']:g} rad on.", "")
        rows = [
            [f"{point['size']:.4g}", point["joint"] or "all", _given(point["delay_ms"])] for point in found["curve"]
        ]
        yield from table(["size, rad", "joint", "seen after, ms"], rows)


def _shortfalls(lines: list[str]) -> Iterator[str]:
    if lines:
        yield from ("", f"## Short of what must be: {len(lines)}", "")
        yield from (f"- {line}" for line in lines[:SHOWN])


def _given(value: float | None) -> str:
    return "-" if value is None else f"{value:g}"


def table(head: list[str], rows: list[list[str]]) -> Iterator[str]:
    """Yield the lines of a table of markdown, its columns as wide as their widest cell."""
    widths = [max(map(len, column)) for column in zip(head, *rows, strict=True)]
    lines = [" | ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in (head, *rows)]
    yield f"| {lines[0]} |"
    yield "|" + "|".join("-" * (width + 2) for width in widths) + "|"
    yield from (f"| {line} |" for line in lines[1:])
