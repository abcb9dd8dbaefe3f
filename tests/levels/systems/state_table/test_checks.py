"""The check of a state table names the row of each mistake; a row takes every case."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rack.levels.systems.state_table.checks import find_flaws
from rack.levels.systems.state_table.table import RowConfig, StateTable, TableError, read_table
from tests.levels.systems.state_table.tables import DOOR, DOORS, LEXICON, find_mistakes, write_table

MOVES = 'when = { place = "between", late = "no" }'
ARRIVED = 'when = { place = ["open", "shut"] }'
JAMS = 'when = { place = "between", late = "yes" }'
DRIVE = 'do = ["take", "drive slowly"]'
TAKE = 'next = "moving"\ndo = ["take"'
EXECUTING, DONE, JAM = 'status = "executing"\n', 'status = "done"', 'reason = "the door jams"\n'
STATES = "idle, executing, done, error, holding"
ROW1, ROW4, ROW5 = "row 1 'open it': ", "row 4 'moves': ", "row 5 'arrived': "
KNOWN, PLACES = "known: lock, place, late, command, new", "its values: open, between, shut"
ACTIONS = "actions with their parameters, in order; the list may be empty"
NO_AJAR = "no row has the state 'ajar'; states: shut, moving"
OVERLAP = (
    "overlaps row 4 'moves' in 'moving' when place = between, late = no; let them exclude each"
    " other, or give the later one else = true"
)
SHOWN = "reason: status done shows none; statuses that do: error, holding"
UNREACHED = "unreachable: no row leads from 'shut' to the state 'moving'"
HOLE = "no row of 'moving' takes lock = locked|stuck, place = between, late = yes"
TAKEN = "the rows above it take every case of it"
NEVER = 'when = { place = ["between"], late = "no" }\nelse = true'
MISTAKES = [
    (MOVES, "place", "plaice", f"{ROW4}when: unknown condition 'plaice'; {KNOWN}"),
    (MOVES, "between", "ajar", f"{ROW4}when: place is never 'ajar'; {PLACES}"),
    (MOVES, '"between"', "[]", f"{ROW4}when: place has an empty list; {PLACES}"),
    (DRIVE, "drive slowly", "fly", f"{ROW1}do: unknown 'fly'; known: drive, take"),
    (
        DRIVE,
        "slowly",
        "ill",
        f"{ROW1}do: 'ill' of 'drive ill' is unknown; known: slowly, fast, stop",
    ),
    (DRIVE, " slowly", "", f"{ROW1}do: 'drive' has 0 parameters; 'drive' takes 1"),
    (TAKE, 'next = "moving"\n', "", f"{ROW1}next: missing; next state, or same"),
    (f"{DRIVE}\n", f"{DRIVE}\n", "", f"{ROW1}do: missing; {ACTIONS}"),
    (
        f"{DRIVE}\n{EXECUTING}",
        EXECUTING,
        "",
        f"{ROW1}status: missing; state shown upwards: {STATES}",
    ),
    (DONE, "done", "finished", f"{ROW5}status: unknown 'finished'; known: {STATES}"),
    (DONE, DONE, f'{DONE}\nreason = "?"', f"{ROW5}{SHOWN}"),
    (JAM, JAM, "", "row 6 'jams': reason: missing; status error needs one, a line for the user"),
    (TAKE, "moving", "ajar", f"{ROW1}next: {NO_AJAR}"),
    (TAKE, "moving", "shut", f"row 4, 5, 6: {UNREACHED}"),
    ('start = "shut"', "shut", "ajar", f"start: {NO_AJAR}"),
    (ARRIVED, ARRIVED, "when = { }", f"{ROW5}{OVERLAP}"),
    (JAMS, '"yes"', '"yes", lock = "free"', f"hole: {HOLE}"),
    (ARRIVED, ARRIVED, NEVER, f"{ROW5}never fires in 'moving': {TAKEN}"),
    ('"idle"', '"idle"', '"idle"\nspeed = 3', "row 3: speed: unknown key; known: name, state"),
    ("width", "width", "height", "plan: height: unknown key; known: width"),
    ("0.9", "0.9", "-1.0", "plan: width: '-1.0': input should be greater than 0"),
]


@pytest.mark.parametrize("case", MISTAKES, ids=[case[3] for case in MISTAKES])
def test_every_mistake_is_found_with_its_row(tmp_path: Path, case: tuple[str, ...]) -> None:
    line, old, new, expected = case
    assert line in DOOR
    assert find_mistakes(tmp_path, DOOR) == []
    found = find_mistakes(tmp_path, DOOR.replace(line, line.replace(old, new)))
    assert any(mistake.startswith(expected) for mistake in found), expected


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
        st.sampled_from(sorted({v for name in NAMES for v in DOORS.conditions[name]})), min_size=1
    ),
    max_size=3,
)


@pytest.mark.slow
@given(st.lists(st.tuples(CONDITIONS, st.booleans()), min_size=1, max_size=7))
def test_a_table_passes_if_one_row_fires_in_each_case(
    rows: list[tuple[dict[str, set[str]], bool]],
) -> None:
    # The only possible mistakes of the rows are their cases.
    configs = {}
    for number, (when, otherwise) in enumerate(rows, 1):
        known = {name: sorted(values & {*DOORS.conditions[name]}) for name, values in when.items()}
        conditions = {name: values for name, values in known.items() if values}
        row = {"name": f"row {number}", "state": "on", "when": conditions, "else": otherwise}
        configs[number] = RowConfig(**row, next="on", do=[], status="idle")
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
