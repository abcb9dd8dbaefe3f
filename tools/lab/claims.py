"""The ledger of claims: each measured figure that a page shows, with what measured it, when and on
which machine.

Pages are written for people, and figures on them outlive the code that they were measured on. So
each stands in claims.toml too, word for word, and a test compares the two: a figure that only the
page has is refused, as is one that is much older than the last change of the room it measures. What
is repeated is repeated by a command, whose JSON holds the number.
"""

from __future__ import annotations

import datetime
import json
import shlex
import shutil
import sys
import tomllib
from collections.abc import Mapping, Sequence
from contextlib import chdir
from dataclasses import dataclass
from difflib import get_close_matches
from functools import cache
from pathlib import Path
from typing import Any

from rack.tools.console.answer import Failure
from rack.tools.lab.benches.checkout import rack_commands
from rack.tools.lab.benches.harness import finished, last_line

ROOT = Path(__file__).resolve().parents[2]
"""The checkout, from which commands are run; of an installed wheel, the folder of the package."""
MOST_LAG_DAYS = 60
"""How much older than the last change of its room a claim may be."""
DRIFT = 2.0
"""What a figure without a spread is permitted, up and down: so much does the speed of a virtual
machine drift within a day."""
BOUND_S = 14_400.0
"""Longest time that a command may take; campaigns take hours."""


@dataclass(frozen=True)
class MeasuredClaim:
    """One measured figure, or those of one table, that pages show."""

    name: str
    text: str
    """What the figure says, in one sentence."""
    shown: Mapping[str, Sequence[str]]
    """Pages, and the figure as it reads there; of a table, each of its rows."""
    figure: float
    """In `unit`, as the command's JSON has it; of a table, one of its figures."""
    unit: str
    date: datetime.date
    commit: str
    """The commit that was measured; where nobody wrote it down, the one that first shows it."""
    machine: str
    room: str
    """Folder or file that is measured."""
    spread: Sequence[float] = ()
    """Lowest and highest of several measurements; empty for one measurement."""
    command: str = ""
    """Repeats the measurement, from a checkout; empty: none does, and `how` says what did."""
    take: Sequence[Any] = ()
    """The way to the figure in the command's JSON: a key, a position in a list, or a table of what
    its item has."""
    how: str = ""

    @property
    def permitted(self) -> tuple[float, float]:
        """Lowest and highest figure that agree with this one."""
        if self.spread:
            low, high = self.spread
            return low, high
        return self.figure / DRIFT, self.figure * DRIFT

    @property
    def permitted_text(self) -> str:
        """The same for people; "-" where no command gives another one."""
        if not self.command:
            return "-"
        low, high = self.permitted
        return f"{low:g} to {high:g}{'' if self.spread else ' (one run)'}"


@dataclass(frozen=True)
class Standing:
    """A claim as it stands today."""

    claim: MeasuredClaim
    age_days: int
    changes_since: int | None = None
    """Commits after the claim's that changed its room; None without the history of the
    checkout."""
    is_overdue: bool = False
    """Whether its room has changed more than 60 days after it was measured."""


@dataclass(frozen=True)
class Repeated:
    """A claim that was measured anew."""

    claim: MeasuredClaim
    now: float

    @property
    def is_within(self) -> bool:
        """Whether the new figure lies within the spread."""
        low, high = self.claim.permitted
        return low <= self.now <= high

    @property
    def ratio(self) -> float | None:
        """The new figure divided by the old one; None where that is 0."""
        return self.now / self.claim.figure if self.claim.figure else None


def read_ledger() -> dict[str, MeasuredClaim]:
    """Return all claims by name."""
    tables = tomllib.loads(Path(__file__).with_name("claims.toml").read_text())["claim"]
    return {name: MeasuredClaim(name=name, **table) for name, table in tables.items()}


def claim_named(name: str, ledger: Mapping[str, MeasuredClaim]) -> MeasuredClaim:
    """Return a claim. Raises `Failure` with the nearest names."""
    if name not in ledger:
        near = get_close_matches(name, ledger, 3) or sorted(ledger)
        raise Failure(f"NAME = {name}: no such claim; nearest: {', '.join(near)}", 2)
    return ledger[name]


def repeated(claim: MeasuredClaim) -> Repeated:
    """Run a claim's command, and take its figure. Raises `Failure` without a command or a
    figure."""
    if not claim.command:
        raise Failure(f"{claim.name}: no command repeats it: {claim.how}", 2)
    program, *words = shlex.split(claim.command)
    programs = {"rack": rack_commands(None)[0].argv, "python": (sys.executable,)}
    with chdir(ROOT):
        ended = finished(claim.command, [*programs[program], *words, "--json"], BOUND_S)
    try:
        return Repeated(claim, taken(json.loads(ended.stdout), claim.take))
    except (AttributeError, LookupError, TypeError, ValueError):
        why = last_line(ended.stderr, f"exit status {ended.returncode}")
        raise Failure(
            f"{claim.name}: `{claim.command}` gave no figure at {list(claim.take)}: {why}"
        ) from None


def taken(found: Any, way: Sequence[Any]) -> float:
    """Return the number in a document that is at the end of a claim's `take`. Raises
    AttributeError, LookupError, TypeError or ValueError where there is none."""
    for step in way:
        if isinstance(step, Mapping):
            (found,) = (item for item in found if step.items() <= item.items())
        else:
            found = found[step]
    return float(found)


def standing(claim: MeasuredClaim, today: datetime.date) -> Standing:
    """Return how a claim stands, by the history of this checkout."""
    age_days = (today - claim.date).days
    commits = _commits_since(claim.commit)
    if commits is None:
        return Standing(claim, age_days)
    days = [
        one.day
        for one in commits
        if any(f"{file}/".startswith(f"{claim.room}/") for file in one.files)
    ]
    is_overdue = any((day - claim.date).days > MOST_LAG_DAYS for day in days)
    return Standing(claim, age_days, len(days), is_overdue)


@dataclass(frozen=True)
class Commit:
    """A commit of this checkout."""

    day: datetime.date
    files: Sequence[str]


@cache
def _commits_since(start: str) -> list[Commit] | None:
    """Return the commits that are not `start`, given by the head of its name, nor before it."""
    commits = _history()
    if not any(name.startswith(start) for name in commits):
        return None
    return [commits[name] for name in _git("rev-list", f"{start}..").split()]


@cache
def _history() -> dict[str, Commit]:
    """Return the commits of this checkout by name; none where git does not have them all."""
    # A wheel may lie within a checkout of something else, whose history says nothing.
    if not (ROOT / ".git").exists() or shutil.which("git") is None:
        return {}
    # The oldest commit that a shallow clone has would seem to change every room.
    if _git("rev-parse", "--is-shallow-repository").strip() != "false":
        return {}
    commits = {}
    for entry in _git("log", "--name-only", "--format=%x00%cs %H").split("\0")[1:]:
        head, *files = entry.splitlines()
        day, name = head.split()
        commits[name] = Commit(datetime.date.fromisoformat(day), files)
    return commits


def _git(*words: str) -> str:
    return finished("git", ["git", "-C", str(ROOT), *words], 30.0).stdout
