"""Times of cycles, misses and system responses, as a report shows them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rack.tools.console.answer import Document
from rack.tools.console.tables import Blocks, TextTable, decimal, figure
from rack.tools.recording.history import counted
from rack.tools.timing.analysis.run_report import RunReport
from rack.tools.timing.analysis.task_times import times_table

SHOWN = 10
"""Most misses, holds and long responses in the text; report.json has them all."""

JUDGED = {True: "ok", False: "beyond", None: "-"}


def the_most(rows: Sequence[Any], which: str) -> str:
    """Return, for a heading, which of the rows are shown; "" if all are."""
    return f"; the {which} {SHOWN}" if len(rows) > SHOWN else ""


def times_text(report: RunReport) -> Blocks:
    """Yield the table of cycles."""
    is_lockstep = report.mode == "lockstep"
    yield from ("", "## Cycles, ms", "")
    if is_lockstep:
        yield (
            "In lockstep a tick lasts as long as its tasks take: there are no deadlines, no"
            " lateness, no residuals."
        )
        yield ""
    for name, (traced, ran) in report.untraced.items():
        yield from (f"Times of {name} are from {traced:,} of {ran:,} cycles.", "")
    yield times_table(report.tasks, is_lockstep)


def misses_text(report: RunReport) -> Blocks:
    """Yield the first missed and skipped cycles, and why they are fewer than tasks counted."""
    misses = report.misses
    late, skipped = counted(misses)
    yield from (
        "",
        f"## Missed and skipped cycles: {late} and {skipped}{the_most(misses, 'first')}",
        "",
    )
    if (late, skipped) != (report.missed, report.skipped):
        of_all = f"{report.missed} and {report.skipped}"
        why = (
            "the recorder lost rows"
            if report.rows_lost
            else "the recording does not hold all of it"
        )
        yield from (f"The tasks counted {of_all}; {why}.", "")
    rows = [
        {
            "tick": miss["tick"],
            "task": miss["task"],
            "what": miss["what"] if miss["what"] == "late" else f"{miss['count']} skipped",
            "started late, ms": decimal(miss.get("started_ms")),
            "took, ms": decimal(miss.get("took_ms")),
        }
        for miss in misses[:SHOWN]
    ]
    yield TextTable(rows)


def response_text(response: Document) -> Blocks:
    """Yield the responses of all chains of levels against their bounds, and what is beyond."""
    yield from ("", "## System response, ms of simulated time")
    for found in (response, *response["others"]):
        yield from _response_along(found)


def _response_along(response: Document) -> Blocks:
    yield ""
    bounds = (
        f"eq. 3.2 bound {response['bound_eq_3_2_ms']:g}, eq. 3.3 sum {response['sum_eq_3_3_ms']:g}"
    )
    yield (
        f"{' > '.join(response['levels'])}: {bounds}; on a fixed grid each level also waits for its"
        " cycle."
    )
    yield ""
    ways = {"command, down": response["command"], "status, up": response["status"]}
    rows = [
        {
            "way": (
                way
                if len(found["levels"]) == len(response["levels"])
                else f"{way} from {found['levels'][0]}"
            ),
            "measured p50": figure(found["measured_ms"], "p50"),
            "measured max": figure(found["measured_ms"], "max"),
            "bound": found["bound_ms"],
            "": JUDGED[found["holds"]],
        }
        for way, found in ways.items()
        if found["levels"]
    ]
    yield TextTable(rows)
    for way, found in ways.items():
        if found["beyond"]:
            yield from (
                "",
                (
                    f"{way}: {len(found['beyond'])} beyond the"
                    f" bound{the_most(found['beyond'], 'longest')}:"
                ),
            )
        for each in sorted(found["beyond"], key=lambda each: -each["ms"])[:SHOWN]:
            why = "; ".join(each["delayed_by"]) or "no cause is recorded"
            yield f"- {each['ms']:g} ms from tick {each['tick']}: {why}"
        if found["unseen"]:
            yield from (
                "",
                f"{way}: {found['unseen']} not measured: messages are missing in the recording.",
            )
