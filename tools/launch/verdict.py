"""The verdict on a run: why it failed, and which checks were not made.

Exit status, first line, report.json, report.md and `--json` all use this verdict.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rack.boards.events import Outcome
from rack.tools.console.answer import Document

UNRECORDED = "the system response: nothing is recorded"
ACROSS_RACKS = (
    "the system response across racks: the config names no other rack in adapter.lan.partners or"
    " launch"
)


def build_verdict(ended: Mapping[str, Any], response: Document | None) -> Document:
    """Decide whether a run worked, from its end and its system response.

    Args:
        ended: A `RunResult` as plain data. Empty if the end of the run was not recorded.
        response: System response. None if the rack has none, or nothing was recorded.

    Returns:
        A document with `worked`, `failures` (one line for each reason), and `unjudged` (one line
        for each check that was not made, with the reason).
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
        failures += _list_long_responses(response)
    return {"worked": not failures, "failures": failures, "unjudged": unjudged}


def list_failures(outcome: Outcome, recording: str, others: str) -> list[str]:
    """List the reasons why a run failed, except a late system response.

    Args:
        outcome: Outcome of the run.
        recording: As in `RunResult`.
        others: Why other racks failed.
    """
    lost = "" if recording in ("complete", "none") else f"the recording is incomplete: {recording}"
    return [why for why in (outcome.failure, lost, others) if why]


def _list_long_responses(response: Document) -> Iterator[str]:
    """Yield a failure for each chain whose response exceeded its bound without a lost cycle."""
    for chains in (response, *response["others"]):
        for direction in ("command", "status"):
            chain = chains[direction]
            if unexcused := [excess for excess in chain["beyond"] if not excess["delayed_by"]]:
                longest = max(unexcused, key=lambda excess: excess["ms"])
                causes = "".join(f"; {cause}" for cause in longest.get("network", ()))
                yield (
                    f"the response of a {direction} along {' > '.join(chain['levels'])} took up to"
                    f" {chain['measured_ms']['max']:g} ms; bound: {chain['bound_ms']:g} ms,"
                    f" {len(unexcused)} times exceeded without a lost cycle{causes}"
                )


def format_headline(rack: str, outcome: Document | None, failures: list[str]) -> str:
    """Return the verdict in one line.

    Args:
        rack: Name of the rack.
        outcome: Outcome of the run. None if it was not recorded.
        failures: Reasons why the run failed.
    """
    if failures or outcome is None:
        return f"{rack} failed: {'; '.join(failures)}"
    return ": ".join(filter(None, (rack, outcome["cause"], outcome["reason"])))
