"""Check of a state table before the launch.

It finds unknown words, unreachable states, overlapping rows and cases that no row takes. The cases
of a state are all combinations of the values of the conditions that its rows name. A set of cases
is stored as a list of boxes, and a box has a set of values for each condition. Subtracting a row
from a box leaves at most as many boxes as the row has conditions.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from rack.levels.systems.state_table.table import (
    SAME,
    STATES,
    Lexicon,
    RowConfig,
    StateTable,
    Vocabulary,
    find_phrase_error,
)
from rack.levels.tables import describe_keys

Box = dict[str, frozenset[str]]
"""A set of cases: the permitted values of each condition."""
STATUSES_WITH_REASON = ("error", "holding")
"""Values of `status` for which a row must give a reason."""
MAX_REPORTED_HOLES = 3
"""Number of uncovered cases of one state that are listed individually."""


def find_flaws(table: StateTable, vocabulary: Vocabulary, lexicon: Lexicon | None) -> list[str]:
    """Return one line for every mistake in a table, with the number and name of the row.

    Args:
        table: Table to check.
        vocabulary: Conditions, commands and actions of the level.
        lexicon: Sets of words that depend on the plan. None if the plan has mistakes; actions are
            then not checked.
    """
    lines = [*table.flaws]
    for number, row in table.configs.items():
        lines += [
            f"{_format_row_name(number, row)}: {why}"
            for why in _find_row_flaws(row, vocabulary, lexicon)
        ]
    lines += _find_state_flaws(table)
    # Rows can be compared only if all are readable and all their conditions and values are known.
    if not table.flaws and not any(
        _find_condition_flaws(row, vocabulary) for row in table.configs.values()
    ):
        for state in table.rows:
            lines += _find_case_flaws(state, table.rows[state], vocabulary)
    return lines


def _format_row_name(number: int, row: RowConfig) -> str:
    return f"row {number} '{row.name}'"


def _find_row_flaws(
    row: RowConfig, vocabulary: Vocabulary, lexicon: Lexicon | None
) -> Iterator[str]:
    """Yield a line for each unknown word in a row and each required key that is missing."""
    yield from _find_condition_flaws(row, vocabulary)
    for phrase in row.do:
        if lexicon is not None and (why := find_phrase_error(phrase, vocabulary.actions, lexicon)):
            yield f"do: {why}"
    for key in ("next", "do", "status"):
        if key not in row.model_fields_set:
            yield f"{key}: missing; {describe_keys(RowConfig)[key].description}"
    if row.status not in STATES:
        yield f"status: unknown '{row.status}'; known: {', '.join(STATES)}"
    if row.status in STATUSES_WITH_REASON and not row.reason and "status" in row.model_fields_set:
        yield f"reason: missing; status {row.status} needs one, a line for the user"
    if row.status not in STATUSES_WITH_REASON and row.reason:
        yield (
            f"reason: status {row.status} shows none; statuses that do: "
            f"{', '.join(STATUSES_WITH_REASON)}"
        )


def _find_condition_flaws(row: RowConfig, vocabulary: Vocabulary) -> list[str]:
    """Return a line for each unknown condition or value in a row."""
    lines = []
    for condition, values in row.when.items():
        if condition not in vocabulary.conditions:
            known = ", ".join(vocabulary.conditions)
            lines.append(f"when: unknown condition '{condition}'; known: {known}")
            continue
        permitted = vocabulary.conditions[condition]
        unknown = [f"is never '{value}'" for value in values if value not in permitted]
        if not values:
            unknown = ["has an empty list"]
        valid = ", ".join(permitted)
        lines += [f"when: {condition} {why}; its values: {valid}" for why in unknown]
    return lines


def _find_state_flaws(table: StateTable) -> Iterator[str]:
    """Yield a line for each next state that does not exist and each state that is unreachable."""
    names = [*table.rows]
    known = ", ".join(names)
    if SAME in names:
        yield f"state: '{SAME}' is no name of a state: `next = \"{SAME}\"` stays in a state"
    if table.start not in names:
        yield f"start: no row has the state '{table.start}'; states: {known}"
    for number, row in table.configs.items():
        if row.next not in (*names, SAME):
            yield (
                f"{_format_row_name(number, row)}: next: no row has the state "
                f"'{row.next}'; states: {known}"
            )
    if table.start not in names:
        return
    reached = [table.start]
    for state in reached:  # the list grows during the loop
        nexts = {row.next for row in table.rows[state].values()}
        reached += [name for name in names if name in nexts and name not in reached]
    for state in names:
        if state not in reached:
            numbers = ", ".join(map(str, table.rows[state]))
            yield (
                f"row {numbers}: unreachable: no row leads from '{table.start}' to the state"
                f" '{state}'"
            )


def _find_case_flaws(
    state: str, rows: Mapping[int, RowConfig], vocabulary: Vocabulary
) -> Iterator[str]:
    """Yield a line for each mistake in the cases that the rows of a state cover.

    Mistakes are rows that overlap, rows with `else` that never fire, and cases without a row.

    Args:
        state: Name of the state.
        rows: Its rows by number, in the order in which they are tried.
        vocabulary: Vocabulary with the possible values of each condition.
    """
    conditions = [
        name for name in vocabulary.conditions if any(name in row.when for row in rows.values())
    ]
    all_cases: Box = {name: frozenset(vocabulary.conditions[name]) for name in conditions}
    boxes: dict[int, Box] = {}  # earlier rows, by number
    uncovered = [all_cases]
    for number, row in rows.items():
        row_name = _format_row_name(number, row)
        box = {**all_cases, **{name: frozenset(values) for name, values in row.when.items()}}
        for earlier_number, earlier_box in boxes.items():
            overlap = {name: values & earlier_box[name] for name, values in box.items()}
            if not row.otherwise and all(overlap.values()):
                earlier = rows[earlier_number]
                shared = {n: overlap[n] for n in conditions if n in row.when or n in earlier.when}
                yield (
                    f"{row_name}: overlaps {_format_row_name(earlier_number, earlier)} in '{state}'"
                    f" when {_format_box(shared)}; let them exclude each other, or give "
                    "the later one"
                    " else = true"
                )
        rest = [piece for box_left in uncovered for piece in subtract_box(box_left, box)]
        if row.otherwise and rest == uncovered:
            yield f"{row_name}: never fires in '{state}': the rows above it take every case of it"
        uncovered = rest
        boxes[number] = box
    for box in uncovered[:MAX_REPORTED_HOLES]:
        yield f"hole: no row of '{state}' takes {_format_cases(box, vocabulary)}"
    if len(uncovered) > MAX_REPORTED_HOLES:
        yield f"hole: '{state}' has {len(uncovered) - MAX_REPORTED_HOLES} more"


def subtract_box(box: Box, removed: Box) -> Sequence[Box]:
    """Return the cases of `box` that are not in `removed`, as disjoint boxes.

    Both boxes must have the same conditions.
    """
    pieces = []
    rest = dict(box)
    for condition, values in removed.items():
        outside = rest[condition] - values
        inside = rest[condition] & values
        if not inside:
            return [box]
        if outside:
            pieces.append({**rest, condition: outside})
        rest[condition] = inside
    return pieces


def _format_cases(box: Box, vocabulary: Vocabulary) -> str:
    """Format the cases of a box, without conditions that may have any value."""
    narrow = {n: values for n, values in box.items() if len(values) < len(vocabulary.conditions[n])}
    return _format_box(narrow)


def _format_box(box: Box) -> str:
    """Format a box such as "arm = moving|resting, hold = no", or "any case" if it is empty."""
    return (
        ", ".join(f"{name} = {'|'.join(sorted(values))}" for name, values in box.items())
        or "any case"
    )
