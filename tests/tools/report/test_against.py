"""Comparison of two runs: the message that differs, its inputs, and the cause."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from rack.boards.config import load
from rack.boards.config.toml import to_toml
from rack.tools.launch.continued import RepeatedRun, load_branch_config
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display
from rack.tools.recording.checksums import format_checked_line
from rack.tools.recording.recording import Recording
from rack.tools.report.against import compare_runs
from rack.tools.report.report import OtherRun
from tests.boards.commanded_racks import COMMANDED, commands
from tests.boards.remembering_racks import REMEMBERING
from tests.tools.command_line import rack, read_refusal

pytestmark = pytest.mark.slow
SECONDS = 0.5
OTHERS = {
    name: {"slot": slot, "rate_hz": 400, "executor": "wave_levels:Wave"}
    for name, slot in (("second", 4), ("third", 5))
}
WAVES = REMEMBERING + to_toml({"board": OTHERS})
FAULTS = """
fault = [
    { kind = "kill", board = "wave", tick = 130 },
    { kind = "corrupt", board = "second", tick = 130, cycles = 4 },
    { kind = "delay", board = "third", tick = 130, cycles = 4 },
]
"""
OWN_LEVEL = """
from time import monotonic_ns
import numpy as np
from rack.levels import Executor, Input, Message, Output, field


class Sum(Message, version=1):
    value: np.ndarray = field(unit="1", doc="sum", shape=2)


class Summing(Executor):
    sum = Output(Sum)

    def __init__(self, context):
        super().__init__(context)
        self._sum = 0.0

    def process(self, tick):
        self._sum += 1.0
        self.sum.value[1] = self._sum if tick < 120 else AFTER


class Passing(Executor):
    below = Input(Sum, "below.sum")
    sum = Output(Sum, rests_on=below)

    def process(self, tick):
        self.sum.value[:] = self.below.message.value
"""
Run = Callable[..., Recording]


def run_in(folder: Path, rack_name: str) -> Run:
    """Return a function that runs a rack for `SECONDS`, and records it."""

    def run(name: str, text: str, *settings: str, faults: str = "") -> Recording:
        file = folder / f"{name}.toml"
        file.write_text(text)
        script = folder / f"{name}-faults.toml"
        script.write_text(faults)
        given = str(script) if faults else None
        config = load(file, [f"name={rack_name}", *settings], given)
        run_rack(config, SECONDS, folder / name, Display())
        return Recording(folder / name)

    return run


@pytest.fixture
def ran(rack_name: str, tmp_path: Path) -> Run:
    return run_in(tmp_path, rack_name)


class Runs(NamedTuple):
    """Runs of the same rack: one, with another parameter, with faults; and one of another rack."""

    one: Recording
    changed: Recording
    faulty: Recording
    commanded: Recording


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Runs:
    run = run_in(tmp_path_factory.mktemp("against"), f"test-against-{os.getpid()}")
    return Runs(
        run("one", WAVES),
        run("two", WAVES, "board.wave.params.factor=2"),
        run("faulty", WAVES, faults=FAULTS),
        run("commanded", COMMANDED),
    )


def explain_difference(
    one: Recording, other: Recording, *, of: str = "", repeats: bool = True
) -> dict[str, Any]:
    """Return the explanation in the report of two runs."""
    return compare_runs(one, OtherRun(other.folder, of, repeats))


@pytest.mark.thorough
def test_equal_runs_have_no_chain(runs: Runs, tmp_path: Path) -> None:
    one = runs.one
    again = Recording(Path(shutil.copytree(one.folder, tmp_path / "again")))
    found = explain_difference(one, again)
    assert (found["first_difference"], found["chain"], found["repetition"]) == (None, [], None)
    assert found["explained"]


def test_a_parameter_is_named_with_the_attributes_that_it_changed(runs: Runs) -> None:
    found = explain_difference(runs.changed, runs.one)
    (cycle,) = found["chain"]
    assert (cycle["tick"], cycle["mailbox"], cycle["writer"]) == (0, "wave.status", "wave")
    assert (cycle["read"], cycle["unequal"]) == ((), "")
    (clue,) = cycle["clues"]
    assert clue["kind"] == "config"
    assert clue["values"] == {"name": "board.wave.params.factor", "here": 2, "there": None}
    repetition = found["repetition"]
    assert (repetition["because"], repetition["runs"], repetition["strays"]) == ("state", (), {})
    assert {"name": "_factor", "here": 2.0, "there": 1.0} in repetition["attributes"]


@pytest.mark.thorough
def test_a_branch_shows_the_state_of_the_level_at_its_first_tick(
    runs: Runs, tmp_path: Path
) -> None:
    one = runs.one
    config = load_branch_config(one, ["board.wave.params.factor=2"], None)
    with RepeatedRun(one) as again:
        run_rack(config, SECONDS, tmp_path / "two", Display(), beginning=again.continue_at(150))
    found = explain_difference(Recording(tmp_path / "two"), one)
    (cycle,) = found["chain"]
    assert (cycle["tick"], cycle["mailbox"]) == (150, "wave.status")
    repetition = found["repetition"]
    assert {"name": "_factor", "here": 2.0, "there": 1.0} in repetition["attributes"]
    assert (repetition["because"], repetition["strays"]) == ("state", {})
    # The branch has the memory of the first run, changed by the parameter alone.
    assert {one["name"] for one in repetition["attributes"]} == {"_factor", "_half"}


@pytest.mark.parametrize(
    ("board", "field", "kinds"),
    [
        ("wave", "tick", {"fault", "died", "skipped"}),
        ("second", "tick", {"fault"}),
        ("third", "visible_at", {"fault"}),
    ],
    ids=["kill", "corrupt", "delay"],
)
def test_a_fault_is_the_cause_and_nothing_is_repeated(
    runs: Runs, board: str, field: str, kinds: set[str]
) -> None:
    found = explain_difference(runs.one, runs.faulty, of=f"{board}.status")
    (cycle,) = found["chain"]
    assert (cycle["tick"], cycle["mailbox"]) == (130, f"{board}.status")
    assert cycle["fields"][0]["name"] == field
    assert {clue["kind"] for clue in cycle["clues"]} == kinds
    assert {clue["run"] for clue in cycle["clues"]} == {str(runs.faulty.folder)}
    assert (found["repetition"], found["not_repeated"]) == (None, "")
    # The chain leads from the watching level, which noticed a loss, to the killed board.
    if "died" in kinds:
        away = explain_difference(runs.one, runs.faulty, of="watch.status")["chain"]
        assert [cycle["mailbox"] for cycle in away] == ["watch.status", "wave.status"]
        assert away[0]["unequal"] == "wave.status"


@pytest.mark.thorough
def test_a_level_whose_code_has_changed_is_named(ran: Run, tmp_path: Path) -> None:
    level = tmp_path / "summing_levels.py"
    adding = {"slot": 2, "rate_hz": 400, "executor": f"{level.stem}:Summing"}
    passing = {"slot": 3, "rate_hz": 50, "below": "adding", "executor": f"{level.stem}:Passing"}
    head = {"format": 2, "name": "summing", "python_path": [str(tmp_path)]}
    clock = {"period_ms": 2.5, "mode": "lockstep"}
    text = to_toml({**head, "clock": clock, "board": {"adding": adding, "passing": passing}})
    level.write_text(OWN_LEVEL.replace("AFTER", "self._sum"))
    one = ran("one", text)
    level.write_text(OWN_LEVEL.replace("AFTER", "self._sum + 1.0"))
    two = ran("two", text)
    found = explain_difference(one, two)
    (cycle,) = found["chain"]
    assert (cycle["tick"], cycle["writer"]) == (120, "adding")
    assert cycle["fields"] == ({"name": "adding.sum.value[1]", "here": 121.0, "there": 122.0},)
    assert cycle["clues"] == ()
    repetition = found["repetition"]
    assert (repetition["because"], repetition["runs"]) == ("code", (str(one.folder),))
    assert repetition["attributes"] == ()
    # The other level only forwards its input.
    chain = explain_difference(one, two, of="passing.sum", repeats=False)["chain"]
    places = [(one["mailbox"], one["unequal"]) for one in chain]
    assert places == [("passing.sum", "adding.sum"), ("adding.sum", "")]


def test_an_operators_command_is_the_cause(runs: Runs, ran: Run) -> None:
    one = runs.commanded
    two = ran("two", COMMANDED, commands("level = 'upper', what = 'hold', tick = 80"))
    (cycle,) = explain_difference(one, two)["chain"]
    assert (cycle["tick"], cycle["mailbox"], cycle["writer"]) == (80, "upper.operator", "clock")
    (clue,) = cycle["clues"]
    assert (clue["kind"], clue["run"]) == ("command", str(two.folder))
    chain = explain_difference(one, two, of="lower.status", repeats=False)["chain"]
    boxes = ["lower.status", "upper.command", "upper.operator"]
    assert [cycle["mailbox"] for cycle in chain] == boxes


def test_the_command_prints_the_chain_and_refuses_what_cannot_be_compared(
    runs: Runs, tmp_path: Path
) -> None:
    one, two = runs.one, runs.changed
    # A copy of a run whose recorder lost rows.
    losing = Path(shutil.copytree(two.folder, tmp_path / "losing"))
    outcome = {**two.end_counts, "rows_lost": {"wave": 3}}
    (losing / "events.jsonl").write_text(format_checked_line(outcome))
    done = rack("report", two.folder, "--against", one.folder)
    assert done.returncode == 1
    assert "  - not repeated: --repeat runs both racks again, up to that cycle" in done.stdout
    assert f"  - board.wave.params.factor is 2, in {one.folder} not set" in done.stdout.splitlines()
    against = (one.folder, "--against")
    for arguments, said in (
        ((*against, runs.commanded.folder), "are of different racks: only the first has 'wave'"),
        ((*against, tmp_path), "not a run"),
        ((*against, losing), "lost 3 rows; the two runs cannot be compared"),
        ((*against, two.folder, "--of", "wave.statu"), "nearest: wave.status"),
        ((one.folder, "--of", "wave.status"), "need --against"),
    ):
        assert said in read_refusal(rack("report", *arguments))
