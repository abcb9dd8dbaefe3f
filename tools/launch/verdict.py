"""The verdict on a run: why it failed, and what was not judged.

Exit status, first line, report.json, report.md and `--json` all take it from here.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rack.boards.events import Outcome
from rack.tools.console.answer import Document

UNRECORDED = "the system response: nothing is recorded"
ACROSS_RACKS = "the system response: there are no bounds yet for a response across racks"


def judge_run(ended: Mapping[str, Any], response: Document | None) -> Document:
    """Judge a run.

    Args:
        ended: The end of the run, a `RunResult` as plain data; empty if it is not recorded.
        response: The system response; None if the rack has none, or nothing is recorded.

    Returns:
        `worked`; `failures`: why it did not, a line each; `unjudged`: what was not judged, and why.
    """
    unjudged: list[str] = []
    failures = ["the end of the run is not recorded"]
    if ended.get("outcome"):
        outcome = Outcome(**ended["outcome"])
        unjudged += outcome.excused
        failures = list_failures(outcome, ended["recording"], ended["failed"])
    if response is not None and response["crosses_racks"]:
        unjudged.append(ACROSS_RACKS)
    elif response is not None:
        failures += _long_responses(response)
    return {"worked": not failures, "failures": failures, "unjudged": unjudged}


def list_failures(outcome: Outcome, recording: str, others: str) -> list[str]:
    """Return why a run failed, as far as its end shows it; `others`: why other racks failed."""
    lost = "" if recording in ("complete", "none") else f"not all is recorded: {recording}"
    return [why for why in (outcome.failure, lost, others) if why]


def _long_responses(response: Document) -> Iterator[str]:
    for chains in (response, *response["others"]):
        for way in ("command", "status"):
            found = chains[way]
            if count := sum(not each["delayed_by"] for each in found["beyond"]):
                yield (
                    f"the response of a {way} along {' > '.join(found['levels'])} took up to"
                    f" {found['measured_ms']['max']:g} ms; bound: {found['bound_ms']:g} ms, {count}"
                    " times exceeded without a lost cycle"
                )


def headline(rack: str, outcome: Document | None, failures: list[str]) -> str:
    """Return the verdict in one line."""
    if failures or outcome is None:
        return f"{rack} failed: {'; '.join(failures)}"
    return ": ".join(filter(None, (rack, outcome["cause"], outcome["reason"])))
