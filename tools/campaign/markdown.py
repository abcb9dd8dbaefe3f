"""A campaign as text for people: campaign.md."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

Report = dict[str, Any]
SHOWN = 30
"""Shortfalls that the text shows; campaign.json has them all."""
KINDS_HEAD = [
    *("kind", "injected", "detected", "in bound", "recovered", "at least", "ticks median", "max", "bound, ticks"),
    *("ms median", "max", "recovery median, ms", "max", "reactions"),
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
        yield from (
            "",
            "At least: the least share of detected, in bound and recovered, as the lower end of Wilson's 95 % interval."
            " A tick is the clock's.",
        )
    yield from _faultless(report["faultless"])
    yield from _sizes(report["sizes"])
    yield from _shortfalls(report["shortfalls"])


def _summary(summary: Report) -> Iterator[tuple[str, Any]]:
    yield "injected", f"{summary['injected']}; {summary['not_struck']} more did not strike, and were drawn again"
    yield "detected", summary["detected"]
    yield "within the bound", summary["within_bound"]
    yield "reacted to", summary["reacted_to"]
    latched = f", of which {summary['latched']} ended the task, as they may" if summary["latched"] else ""
    yield "recovered from", f"{summary['recovered']}{latched}"
    ends = [f"{summary[key]} {name}" for key, name in _ENDS if summary[key]]
    yield "trials ended", ", ".join(ends) or "none"
    yield "limits violated", f"{summary['limits_violated']} (in any substep of any run)"
    yield "touches", summary["touches"]
    yield "left behind", f"{summary['left_behind']} (processes, segments)"
    hours = f"{summary['simulated_s'] / 3600.0:.2f} simulated hours"
    yield "false detections", f"{summary['unexplained']} in {hours}: {_rate(summary['unexplained_per_hour'])}"
    yield "misses in real time that no fault explains", summary["stray_misses"]
    if summary["faultless_s"]:
        rate = _rate(summary["false_trips_per_hour"])
        yield (
            "of these without faults, in real time",
            f"{summary['false_trips']} in {summary['faultless_s']:g} s: {rate}",
        )


def _rate(found: Report | None) -> str:
    return "-" if found is None else f"{found['an_hour']:.3g} an hour, below {found['below']:.3g} with 95 %"


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
        *(str(figures[key]) for key in ("injected", "detected", "within_bound", "recovered")),
        "-" if None in (shares := list(figures["wilson"].values())) else f"{min(low for low, _ in shares):.1%}",
        *_spread(figures["ticks"]),
        spans,
        *_spread(figures["ms"]),
        *_spread(figures["recovery_ms"]),
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
            f"beside {part['load']}" if part["load"] else "alone",
            f"{part['seconds']:.0f}",
            str(part["trips"]),
            _rate(part["trips_per_hour"]),
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
