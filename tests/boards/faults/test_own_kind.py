"""A new kind of fault is one record: listed, checked, acted, detected, drawn and judged with no
other change."""

from __future__ import annotations

import sys
from collections.abc import Iterator

import pytest

from rack.boards import Rack
from rack.boards.config import resolve_layout
from rack.boards.config.injections import build_injections
from rack.boards.faults import KINDS, Kind, Parameter
from rack.boards.faults.bounds import cycle_bound
from rack.tools.commands.inject import format_kinds
from tests.boards.conftest import PLAIN, MakeConfig

MODULE = "gauge_levels"
GAUGED = PLAIN.replace("wave_levels:Wave", f"{MODULE}:Gauge").replace(
    "wave_levels:Watch", f"{MODULE}:GaugeWatch"
)


@pytest.fixture(autouse=True)
def _forget(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Forget the kind after the test: other tests go through all kinds."""
    monkeypatch.setattr(KINDS, "names", dict(KINDS.names))
    monkeypatch.setattr(KINDS, "_by_number", dict(KINDS._by_number))
    yield
    sys.modules.pop(MODULE, None)


def fault(keys: str) -> str:
    return f'fault=[{{ kind = "lose-every", board = "wave", {keys} }}]'


def test_a_users_kind_is_listed_with_its_bound_and_parameters(config: MakeConfig) -> None:
    resolve_layout(config(text=GAUGED))
    text = "\n".join(format_kinds())
    # The columns of a table fold in a pipe.
    words = text.split()
    row = words[words.index("lose-every") :][:20]
    assert {"every", "n-th", "message", "is", "lost", "1", "write", "+", "delivery"} <= set(row)
    lines = [line.split("  ") for line in text.splitlines() if line.startswith("lose-every ")]
    _, parameter = ([cell.strip() for cell in line if cell] for line in lines)
    assert parameter == ["lose-every", "n", "messages", "4", "2 to 8", "the n"]


@pytest.mark.parametrize("valve", ["open", "OPEN", "3"])
def test_a_fault_begins_when_a_field_has_a_value_of_a_users_enum(
    config: MakeConfig, valve: str
) -> None:
    found = config(fault(f'cycles = 80, when = "wave.status.valve == {valve}"'), text=GAUGED)
    layout = resolve_layout(found)
    (injection,) = build_injections(found, layout)
    fields = [field.name for field in layout.mailboxes[0].fields]
    assert injection.when == (0, fields.index("valve"), 3)


@pytest.mark.slow
def test_a_users_kind_acts_and_is_detected(config: MakeConfig) -> None:
    lossy = fault('cycles = 80, n = 4, when = "wave.status.valve == open"')
    with Rack(config(lossy, text=GAUGED)) as rack:
        outcome = rack.run(1.0)
        events = rack.events
    assert outcome.is_success
    begins = next(event for event in events if event.kind == "fault")
    assert (begins.tick, begins.text.partition(",")[0]) == (42, "lose-every (n 4 messages) begins")
    detected = next(event for event in events if event.kind == "detection")
    assert (detected.code, detected.subject) == ("gap", "wave.status")
    assert sum(event.kind == "fault" and "acted 20 time" in event.text for event in events) == 1


def test_two_kinds_of_one_name_are_refused() -> None:
    with pytest.raises(ValueError, match="kind 'kill' has the number of 'kill'; rename it"):
        KINDS.add(Kind("kill", "process", "", (), cycle_bound(1)))


def test_a_kind_has_no_more_parameters_than_an_entry_of_the_fault_table_holds() -> None:
    nine = tuple(Parameter(f"p{at}", "1", "a number", 0, 0, 1) for at in range(9))
    with pytest.raises(ValueError, match="kind 'many' has 9 parameters; at most 8 are allowed"):
        KINDS.add(Kind("many", "process", "", (), cycle_bound(1), parameters=nine))


def test_a_kind_that_this_process_has_not_imported_is_an_unknown_fault() -> None:
    assert KINDS[1].name == "unknown fault"
