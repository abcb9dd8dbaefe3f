"""A campaign on a board with a standby beside the same campaign on that board without one.

Both campaigns draw the same faults, all of that board. With a standby each fault strikes the copy
that is then active: they alternate, because every loss makes another copy active.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import median

from rack.boards.config.schema import RackConfig
from rack.tools.console.answer import Document, Failure
from rack.tools.console.progress import Progress
from rack.tools.console.tables import format_markdown_table
from rack.tools.faults.campaigns.campaign import Campaign, Order
from rack.tools.faults.campaigns.results import Results

WITHOUT, WITH = "without-standby", "with-standby"
"""Folders of the two campaigns."""
HEAD = (
    "board",
    "faults",
    "ticks until output: median",
    "max",
    "brakes engaged",
    "messages missed",
    "recovered",
)


@dataclass(frozen=True)
class Outages:
    """Effects of the faults of one campaign on the output of their board.

    Attributes:
        board: The board, "with standby" or without.
        faults: Number of faults that acted.
        median_ticks: Median of the ticks from a fault to the next cycle that writes messages. None
            if no fault interrupted the output.
        max_ticks: Longest such time.
        braked: Number of faults that made the brakes engage before there was output again.
        missed: Number of messages missing in the mailboxes of the board, in all trials. Those of
            ticks that the clock skipped are not counted.
        recovered: Number of faults after which the rack recovered.
    """

    board: str
    faults: int
    median_ticks: float | None
    max_ticks: int | None
    braked: int
    missed: int
    recovered: int


def list_standby_settings(config: RackConfig, board: str) -> tuple[str, ...]:
    """Return the settings that give a board a standby. None are needed if it has one.

    Raises:
        Failure: There is no such board, or no free slot.
    """
    if board not in config.board:
        names = ", ".join(config.board)
        raise Failure(f"--standby {board}: there is no such board; boards: {names}", 2)
    if config.board[board].standby:
        return ()
    free = config.list_free_slots()
    if not free:
        raise Failure(f"--standby {board}: all slots are taken; free one for the standby", 2)
    cores = sorted(os.sched_getaffinity(0))
    core = next((core for core in cores if core != config.board[board].core), cores[0])
    return (f"board.{board}.standby={{slot={free[-1]},core={core}}}",)


def remove_standby(config: RackConfig, board: str) -> RackConfig:
    """Return a config without the standbys of a board."""
    alone = config.board[board].model_copy(update={"standby": (), "compare": False, "vote": False})
    return config.model_copy(update={"board": {**config.board, board: alone}})


def compare_campaigns(
    order: Order, folder: Path, progress: Progress, whole: bool
) -> tuple[tuple[Campaign, Results], ...]:
    """Run a campaign on a board without its standby, and the same campaign with it.

    Args:
        order: Specification of the campaign. Its config has the standby.
        folder: Folder of both campaigns.
        progress: Progress display.
        whole: Whether every trial runs from tick 0.

    Returns:
        Both campaigns with their results.
    """
    config = remove_standby(order.config, order.board)
    alone = Campaign(replace(order, config=config), folder / WITHOUT, progress, whole)
    # Draw faults of the same kinds.
    order = replace(order, kinds=",".join(alone.kinds))
    other = Campaign(order, folder / WITH, progress, whole)
    return tuple((campaign, campaign.run()) for campaign in (alone, other))


def build_comparison(
    pair: Sequence[Results], reports: Sequence[tuple[Document, str]]
) -> tuple[Document, str]:
    """Compare the results of two campaigns on a board.

    Args:
        pair: Results without and with a standby.
        reports: Documents and texts of both campaigns.

    Returns:
        The figures of both with their documents, and a table with their shortfalls.
    """
    rows = [
        _summarize_outages(name.replace("-", " "), results)
        for name, results in zip((WITHOUT, WITH), pair, strict=True)
    ]
    shortfalls = [
        f"{row.board}: {line}"
        for row, (document, _) in zip(rows, reports, strict=True)
        for line in document["shortfalls"]
    ]
    cells = [["-" if v is None else f"{v}" for v in asdict(row).values()] for row in rows]
    document = {
        "comparison": [asdict(row) for row in rows],
        "campaigns": [document for document, _ in reports],
        "shortfalls": shortfalls,
        "interrupted": any(results.is_interrupted for results in pair),
    }
    lines = [*format_markdown_table(HEAD, cells), *(f"- {line}" for line in shortfalls)]
    return document, "\n".join(lines) + "\n"


def _summarize_outages(name: str, results: Results) -> Outages:
    """Summarize the effects of a campaign's faults on the output of their board."""
    faults = [fault for fault in results.faults if fault.struck >= 0]
    outages = [outage for run in results.trials for outage in run.outages]
    ticks = [outage.ticks for outage in outages]
    return Outages(
        board=name,
        faults=len(faults),
        median_ticks=median(ticks) if ticks else None,
        max_ticks=max(ticks, default=None),
        braked=sum(outage.has_braked for outage in outages),
        missed=sum(run.missing for run in results.trials),
        recovered=sum(fault.is_recovered for fault in faults),
    )
