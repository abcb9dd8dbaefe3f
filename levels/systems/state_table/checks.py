"""The check of a state table: unknown words, unreachable states, overlapping rows, cases that no
row takes.

The cases of a state are the combinations of the values of all conditions that its rows name. A set
of cases is kept as boxes, a set of values per condition each; what a row leaves of a box are at
most as many boxes as it has conditions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations

from rack.levels.systems.state_table.table import (
    SAME,
    STATES,
    Lexicon,
    RowConfig,
    StateTable,
    Vocabulary,
    objection,
)
from rack.levels.tables import keys_of

Box = dict[str, frozenset[str]]
"""A set of cases: the values permitted by condition."""
REASONED = ("error", "holding")
"""Values of `status` that need a reason."""
MAX_HOLES = 3
"""Holes of one state that are reported one by one."""


def flaws(table: StateTable, vocabulary: Vocabulary, lexicon: Lexicon | None) -> list[str]:
    """Return every mistake in a table, a line each, with the number and name of the row.

    Without a lexicon, since the plan has mistakes, actions are not checked.
    """
    found = [*table.flaws]
    for number, row in table.configs.items():
        found += [f"{_named(number, row)}: {why}" for why in _words(row, vocabulary, lexicon)]
    found += _states(table)
    # Cases can be counted only once every condition and value is known, and every row is readable.
    if not table.flaws and not any(_conditions(row, vocabulary) for row in table.configs.values()):
        for state in table.rows:
            found += _cases(state, table.rows[state], vocabulary)
    return found


def _named(number: int, row: RowConfig) -> str:
    return f"row {number} '{row.name}'"


def _words(row: RowConfig, vocabulary: Vocabulary, lexicon: Lexicon | None) -> Iterator[str]:
    """Yield unknown words of a row, and outputs that it lacks."""
    yield from _conditions(row, vocabulary)
    for phrase in row.do:
        if lexicon is not None and (why := objection(phrase, vocabulary.actions, lexicon)):
            yield f"do: {why}"
    for key in ("next", "do", "status"):
        if key not in row.model_fields_set:
            yield f"{key}: missing; {keys_of(RowConfig)[key].description}"
    if row.status not in STATES:
        yield f"status: unknown '{row.status}'; known: {', '.join(STATES)}"
    if row.status in REASONED and not row.reason and "status" in row.model_fields_set:
        yield f"reason: missing; status {row.status} needs one, a line for the user"
    if row.status not in REASONED and row.reason:
        yield f"reason: status {row.status} shows none; statuses that do: {', '.join(REASONED)}"


def _conditions(row: RowConfig, vocabulary: Vocabulary) -> list[str]:
    """Return the unknown conditions and values of a row."""
    found = []
    for condition, values in row.when.items():
        if condition not in vocabulary.conditions:
            known = ", ".join(vocabulary.conditions)
            found.append(f"when: unknown condition '{condition}'; known: {known}")
            continue
        permitted = vocabulary.conditions[condition]
        unknown = [f"is never '{value}'" for value in values if value not in permitted]
        if not values:
            unknown = ["has an empty list"]
        its_values = ", ".join(permitted)
        found += [f"when: {condition} {why}; its values: {its_values}" for why in unknown]
    return found


def _states(table: StateTable) -> Iterator[str]:
    """Yield next states that do not exist, and states that no row leads to."""
    names = [*table.rows]
    known = ", ".join(names)
    if SAME in names:
        yield f"state: '{SAME}' is no name of a state: `next = \"{SAME}\"` stays in a state"
    if table.start not in names:
        yield f"start: no row has the state '{table.start}'; states: {known}"
    for number, row in table.configs.items():
        if row.next not in (*names, SAME):
            yield f"{_named(number, row)}: next: no row has the state '{row.next}'; states: {known}"
    if table.start not in names:
        return
    reached = [table.start]
    for state in reached:  # grows on the way
        nexts = {row.next for row in table.rows[state].values()}
        reached += [name for name in names if name in nexts and name not in reached]
    for state in names:
        if state not in reached:
            numbers = ", ".join(map(str, table.rows[state]))
            yield (
                f"row {numbers}: unreachable: no row leads from '{table.start}' to the state"
                f" '{state}'"
            )


def _cases(state: str, rows: Mapping[int, RowConfig], vocabulary: Vocabulary) -> Iterator[str]:
    """Yield overlaps of the rows of one state, rows that never fire, and cases that no row
    takes.
    """
    named = [
        name for name in vocabulary.conditions if any(name in row.when for row in rows.values())
    ]
    every: Box = {name: frozenset(vocabulary.conditions[name]) for name in named}
    boxes: dict[int, Box] = {}  # of the rows above, by number
    left = [every]
    for number, row in rows.items():
        here = _named(number, row)
        box = {**every, **{name: frozenset(values) for name, values in row.when.items()}}
        for other, above in boxes.items():
            both = {name: values & above[name] for name, values in box.items()}
            if not row.otherwise and all(both.values()):
                before = rows[other]
                shared = {n: both[n] for n in named if n in row.when or n in before.when}
                yield (
                    f"{here}: overlaps {_named(other, before)} in '{state}' when"
                    f" {_listed(shared)}; let them exclude each other, or give the later one else ="
                    " true"
                )
        rest = [piece for whole in left for piece in without(whole, box)]
        if row.otherwise and rest == left:
            yield f"{here}: never fires in '{state}': the rows above it take every case of it"
        left = rest
        boxes[number] = box
    left = joined(left)
    for box in left[:MAX_HOLES]:
        yield f"hole: no row of '{state}' takes {_described(box, vocabulary)}"
    if len(left) > MAX_HOLES:
        yield f"hole: '{state}' has {len(left) - MAX_HOLES} more"


def without(box: Box, taken: Box) -> Sequence[Box]:
    """Return disjoint boxes that hold the cases of `box` that are not in `taken`; both name the
    same conditions.
    """
    pieces = []
    rest = dict(box)
    for condition, values in taken.items():
        outside = rest[condition] - values
        inside = rest[condition] & values
        if not inside:
            return [box]
        if outside:
            pieces.append({**rest, condition: outside})
        rest[condition] = inside
    return pieces


def joined(boxes: Sequence[Box]) -> list[Box]:
    """Return fewer boxes with the same cases: two that differ in one condition become one."""
    left = [*boxes]
    while pair := next((p for p in combinations(left, 2) if _differ_once(*p)), None):
        one, other = pair
        left[left.index(one)] = {name: one[name] | other[name] for name in one}
        left.remove(other)
    return left


def _differ_once(one: Box, other: Box) -> bool:
    return sum(one[name] != other[name] for name in one) == 1


def _described(box: Box, vocabulary: Vocabulary) -> str:
    """Return the cases of a box as text, without the conditions that may have any value."""
    narrow = {n: values for n, values in box.items() if len(values) < len(vocabulary.conditions[n])}
    return _listed(narrow)


def _listed(box: Box) -> str:
    return (
        ", ".join(f"{name} = {'|'.join(sorted(values))}" for name, values in box.items())
        or "any case"
    )
