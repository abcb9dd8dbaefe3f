"""The bench of boards: a message takes as many cycles as there are boards, and costs lie on a
line."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from rack.boards.config import loads, wire
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.boards import measure
from rack.tools.lab.benches.chain import LONGEST, Chain
from rack.tools.lab.benches.chain_figures import Boards, ChainFigures, Fit
from rack.tools.lab.benches.observed import Runs
from tests.test_architecture import ROOT
from tests.tools.command_line import rack

pytestmark = pytest.mark.thorough

SHORT = ChainFigures(2, 800, 150.0, 0.0, 0.0, {2: 400}, {2: 400}, {"this tree": 120.0})


def test_a_chain_of_boards_fills_the_crate() -> None:
    layout = wire(loads(Chain(LONGEST, 400).text()))
    assert [task.slot for task in layout.tasks] == list(range(2, 22))
    assert layout.mailbox("board19.status").readers == ("board20",)


@pytest.mark.slow
def test_messages_take_as_many_cycles_as_there_are_boards(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    found = measure((2, 5), Runs(0.2, 1, True), ROOT, Progress())
    assert found.exact
    assert found.trees == ("this tree", ROOT.name)
    for one in found.chains:
        assert {*one.lockstep_responses} == {one.boards}
        assert min(one.responses) == one.boards
        assert 0 < one.cycles <= 80 * one.boards
        assert one.processor_us > 0
        assert all(one.lockstep_us[tree] > 0 for tree in found.trees)
    assert found.absent
    assert any("rt-tests" in line for line in found.lines())
    assert "ratio" in "\n".join(found.lines())
    # Two points are on a line whatever they are.
    assert json.loads(json.dumps(found.document()))["fit"] is None


def test_a_message_late_without_a_miss_is_not_exact() -> None:
    assert SHORT.exact
    assert not replace(SHORT, responses={2: 399, 3: 1}).exact
    assert replace(SHORT, responses={2: 399, 3: 1}, missed=0.01).exact
    # Earlier than that none can be, and in lockstep none is late.
    assert not replace(SHORT, responses={1: 1, 2: 399}, missed=0.01).exact
    assert not replace(SHORT, lockstep_responses={2: 399, 3: 1}).exact
    found = Boards((SHORT, replace(SHORT, responses={3: 400})), ("this tree",), 2, ())
    assert not found.exact
    assert sum("INEXACT" in line for line in found.lines()) == 1


def test_a_chain_is_held_up_to_its_bound_beyond_cyclictest() -> None:
    assert replace(SHORT, missed=0.0009).held
    assert not replace(SHORT, missed=0.0012).held
    assert replace(SHORT, missed=0.0012, late=0.0005).held


def test_costs_on_a_line_are_found_to_be_linear() -> None:
    fit = Fit.of((1, 10, 20), (150.0, 600.0, 1100.0))
    assert fit is not None
    assert (fit.board_us, fit.base_us, fit.r2) == pytest.approx((50.0, 100.0, 1.0))
    bent = Fit.of((1, 10, 20), (150.0, 600.0, 2400.0))
    assert bent is not None
    assert bent.r2 < 0.95
    assert Fit.of((1, 20), (1.0, 2.0)) is None


@pytest.mark.slow
def test_costs_are_drawn_with_their_line(tmp_path: Path) -> None:
    chains = [
        replace(SHORT, boards=n, processor_us=50.0 * n + 100.0, lockstep_us={"ours": 40.0 * n})
        for n in (1, 5, 9)
    ]
    found = Boards(tuple(chains), ("ours",), 2, ())
    assert found.document()["fit"]["board_us"] == pytest.approx(50.0)
    assert found.document()["lockstep_fit"]["ours"]["board_us"] == pytest.approx(40.0)
    assert sum("us a board" in line for line in found.lines()) == 2
    assert all(path.stat().st_size for path in found.plot(tmp_path))


def test_a_crate_takes_no_longer_chain() -> None:
    done = rack("bench", "boards", "--count", LONGEST + 1)
    assert done.returncode == 2
    assert f"up to {LONGEST} boards" in done.stderr
