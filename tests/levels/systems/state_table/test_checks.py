"""The check of a state table finds every mistake and names its row.

A table that passes has a row for every case.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rack.levels.systems.state_table.checks import find_flaws
from rack.levels.systems.state_table.table import RowConfig, StateTable, TableError, read_table
from tests.levels.systems.state_table.tables import DOOR, DOORS, LEXICON, find_mistakes, write_table

MOVES = 'when = { place = "between", late = "no" }'
ARRIVED = 'when = { place = ["open", "shut"] }'
JAMS = 'when = { place = "between", late = "yes" }'
DRIVE = 'do = ["take", "drive slowly"]'
TAKE = 'next = "moving"\ndo = ["take"'
STATES = "idle, executing, done, error, holding"
MISTAKES = {
    "unknown condition": (
        MOVES,
        MOVES.replace("place", "plaice"),
        "row 4 'moves': when: unknown condition 'plaice'; known: lock, place, late, command, new",
    ),
    "unknown value": (
        MOVES,
        MOVES.replace("between", "ajar"),
        "row 4 'moves': when: place is never 'ajar'; its values: open, between, shut",
    ),
    "no value": (
        MOVES,
        MOVES.replace('"between"', "[]"),
        "row 4 'moves': when: place has an empty list; its values: open, between, shut",
    ),
    "unknown action": (
        DRIVE,
        'do = ["take", "fly"]',
        "row 1 'open it': do: unknown 'fly'; known: drive, take",
    ),
    "unknown parameter": (
        DRIVE,
        'do = ["drive gently"]',
        "row 1 'open it': do: 'gently' of 'drive gently' is unknown; known: slowly, fast, stop",
    ),
    "missing parameter": (
        DRIVE,
        'do = ["drive"]',
        "row 1 'open it': do: 'drive' has 0 parameters; 'drive' takes 1",
    ),
    "missing next": (
        TAKE,
        'do = ["take"',
        "row 1 'open it': next: missing; next state, or same",
    ),
    "missing do": (
        DRIVE + "\n",
        "",
        "row 1 'open it': do: missing; actions with their parameters, in order; the list may be"
        " empty",
    ),
    "missing status": (
        f'{DRIVE}\nstatus = "executing"\n',
        DRIVE + "\n",
        f"row 1 'open it': status: missing; state shown upwards: {STATES}",
    ),
    "unknown status": (
        'status = "done"',
        'status = "finished"',
        f"row 5 'arrived': status: unknown 'finished'; known: {STATES}",
    ),
    "missing reason": (
        'reason = "the door jams"\n',
        "",
        "row 6 'jams': reason: missing; status error needs one, a line for the user",
    ),
    "reason without a use": (
        'status = "done"',
        'status = "done"\nreason = "why not"',
        "row 5 'arrived': reason: status done shows none; statuses that do: error, holding",
    ),
    "unknown next state": (
        TAKE,
        TAKE.replace("moving", "ajar"),
        "row 1 'open it': next: no row has the state 'ajar'; states: shut, moving",
    ),
    "unreachable state": (
        TAKE,
        TAKE.replace("moving", "shut"),
        "row 4, 5, 6: unreachable: no row leads from 'shut' to the state 'moving'",
    ),
    "unknown start": (
        'start = "shut"',
        'start = "ajar"',
        "start: no row has the state 'ajar'; states: shut, moving",
    ),
    "overlap": (
        ARRIVED,
        "when = { }",
        "row 5 'arrived': overlaps row 4 'moves' in 'moving' when place = between, late = no; let"
        " them exclude each other, or give the later one else = true",
    ),
    "hole": (
        JAMS,
        JAMS.replace('"yes"', '"yes", lock = "free"'),
        "hole: no row of 'moving' takes lock = locked|stuck, place = between, late = yes",
    ),
    "row that never fires": (
        ARRIVED,
        'when = { place = ["between"], late = "no" }\nelse = true',
        "row 5 'arrived': never fires in 'moving': the rows above it take every case of it",
    ),
    "unknown key": (
        'status = "idle"',
        'status = "idle"\nspeed = 3',
        "row 3: speed: unknown key; known: name, state",
    ),
    "unknown key of the plan": ("width", "height", "plan: height: unknown key; known: width"),
    "value of the plan": ("0.9", "-1.0", "plan: width: '-1.0': input should be greater than 0"),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_every_mistake_is_found_with_its_row(tmp_path: Path, mistake: str) -> None:
    before, after, expected = MISTAKES[mistake]
    assert before in DOOR
    assert find_mistakes(tmp_path, DOOR) == []
    assert any(
        line.startswith(expected) for line in find_mistakes(tmp_path, DOOR.replace(before, after))
    ), expected


@pytest.mark.parametrize(
    "text", ["start = ", "start = 3", 'start = "shut"', "\x00", 'start = "shut"\nrow = 5']
)
def test_a_file_that_is_not_a_table_is_a_single_error(tmp_path: Path, text: str) -> None:
    with pytest.raises(TableError):
        read_table(write_table(tmp_path, text), DOORS)
    with pytest.raises(TableError, match="cannot be read: No such file"):
        read_table(tmp_path / "none.toml", DOORS)


NAMES = tuple(DOORS.conditions)
CONDITIONS = st.dictionaries(
    st.sampled_from(NAMES),
    st.sets(
        st.sampled_from(sorted({v for name in NAMES for v in DOORS.conditions[name]})),
        min_size=1,
    ),
    max_size=3,
)


def row_config(number: int, when: dict[str, set[str]], otherwise: bool) -> RowConfig:
    """Return a row of the state "on" whose only possible mistakes are its cases."""
    known = {name: sorted(values & set(DOORS.conditions[name])) for name, values in when.items()}
    conditions = {name: values for name, values in known.items() if values}
    return RowConfig(
        **{"name": f"row {number}", "state": "on", "when": conditions, "else": otherwise},
        next="on",
        do=[],
        status="idle",
    )


@pytest.mark.slow
@settings(deadline=None)
@given(st.lists(st.tuples(CONDITIONS, st.booleans()), min_size=1, max_size=7))
def test_a_table_passes_exactly_if_one_row_fires_in_every_case(
    rows: list[tuple[dict[str, set[str]], bool]],
) -> None:
    configs = {number: row_config(number, *row) for number, row in enumerate(rows, 1)}
    table = StateTable("on", 1.0, configs, DOORS.plan(), 0, ())
    complaints = find_flaws(table, DOORS, LEXICON)
    cases = [
        dict(zip(NAMES, values, strict=True))
        for values in product(*(DOORS.conditions[name] for name in NAMES))
    ]
    on = table.rows["on"]
    fires = [[row for row in on.values() if row.matches_case(case)] for case in cases]
    assert any("hole" in line for line in complaints) == any(not rows for rows in fires)
    assert any("overlaps" in line for line in complaints) == any(
        not row.otherwise for rows in fires for row in rows[1:]
    )
    if not complaints:
        assert all(table.choose_row("on", case)[0] for case in cases)
