"""`rack claims`: the measured figures of the pages, with their age; one of them measured anew."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from datetime import date
from typing import Annotated

import typer

from rack.tools.console.answer import Document, Failure, print_answer
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json
from rack.tools.lab.claims import (
    MeasuredClaim,
    Repeated,
    Standing,
    claim_named,
    read_ledger,
    repeated,
    standing,
)


def claim_names(start: str) -> list[str]:
    """Return the claims whose names begin with `start`, for shell completion."""
    return [name for name in read_ledger() if name.startswith(start)]


Names = Annotated[
    list[str] | None,
    typer.Argument(
        metavar="NAME",
        help="only these claims, with all that is known of them",
        autocompletion=claim_names,
    ),
]
Again = Annotated[
    bool, typer.Option("--again", help="measure the claim anew, and show both figures")
]


def claims(names: Names = None, again: Again = False, as_json: Json = False) -> None:
    """List the measured figures that the pages show; or measure one anew.

    "Permitted" is the spread of a claim's measurements; of one measured once, half to twice its
    figure. "Days" is its age, "changes since" counts the commits after its own that changed what it
    measures. A claim is overdue if such a change came more than 60 days after it. All are in
    tools/lab/claims.toml; a test compares the pages with it.

    With --again the command of one claim runs in the checkout, some for minutes, some for an hour.
    The new figure is shown next to the old one, with their ratio; no file is changed. Times mean
    little unless the machine has nothing else to do.

    Exit status: 0 listed, or the new figure lies within what is permitted; 1 it does not, or the
    command gave none; 2 no such claim, or none that a command repeats.

    \b
    Examples:
      rack claims
      rack claims message-200-bytes
      rack claims --again a-run-of-nasrem
      rack claims --json | jq '.[] | select(.is_overdue)'
    """
    ledger = read_ledger()
    chosen = [standing(claim_named(name, ledger), date.today()) for name in names or ledger]
    if not again:
        lines = _details(chosen) if names else _overview(chosen)
        print_answer([_document(one) for one in chosen], lines, as_json)
        return
    if len(chosen) != 1 or not names:
        raise Failure("--again needs one NAME, as in: rack claims --again NAME", 2)
    found = _measured(chosen[0].claim, as_json)
    now = {"now": found.now, "ratio": found.ratio, "within": found.is_within}
    print_answer(_document(chosen[0]) | now, _compared(found), as_json)
    raise typer.Exit(0 if found.is_within else 1)


def _measured(claim: MeasuredClaim, as_json: bool) -> Repeated:
    from rack.tools.console.progress import progress_for

    with INTERRUPT.raising(), progress_for(as_json) as progress:
        if claim.command:
            progress.begin(claim.command)
        return repeated(claim)


def _overview(chosen: list[Standing]) -> Iterator[str]:
    from rack.tools.console.tables import fitted

    head = ["claim", "figure", "permitted", "days", "commit", "changes since", "text"]
    rows = [
        [
            one.claim.name,
            f"{one.claim.figure:g} {one.claim.unit}",
            one.claim.permitted_text,
            _age(one),
            one.claim.commit,
            _changes(one),
            one.claim.text,
        ]
        for one in chosen
    ]
    return fitted(head, rows, ("text", "permitted"))


def _details(chosen: list[Standing]) -> Iterator[str]:
    for one in chosen:
        claim = one.claim
        yield f"{claim.name}: {claim.text}"
        yield f"  {claim.figure:g} {claim.unit}; permitted: {claim.permitted_text}"
        yield f"  {claim.date}, age in days: {_age(one)}; commit {claim.commit}; {claim.machine}"
        yield f"  measures {claim.room}; commits that have changed it since: {_changes(one)}"
        yield f"  by: {claim.command or claim.how}"
        for page, texts in claim.shown.items():
            yield from (f"  {page}: {text}" for text in texts)


def _compared(found: Repeated) -> Iterator[str]:
    claim = found.claim
    ratio = "" if found.ratio is None else f", {found.ratio:.2f} times"
    verdict = "within" if found.is_within else "outside"
    yield f"{claim.name}: {claim.text}"
    yield f"  {claim.date}: {claim.figure:g} {claim.unit}; permitted: {claim.permitted_text}"
    yield f"  now: {found.now:g} {claim.unit}{ratio}: {verdict}"


def _document(one: Standing) -> Document:
    found: Document = asdict(one)
    return {
        **found.pop("claim"),
        "date": str(one.claim.date),
        "permitted": one.claim.permitted,
        **found,
    }


def _age(one: Standing) -> str:
    return f"{one.age_days}{' overdue' if one.is_overdue else ''}"


def _changes(one: Standing) -> str:
    return "unknown" if one.changes_since is None else f"{one.changes_since}"
