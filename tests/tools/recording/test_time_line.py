"""Recordings of several racks on one time line, connected by their clock comparisons."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rack.levels.peer import DRIFT_PPM
from rack.tools.console.answer import Failure
from rack.tools.recording.time_line import RackAlignment, align_racks
from tests.tools.command_line import read_failure
from tests.tools.machines import CLOCK_NS, ERROR_NS, MS, TICKS, A, B, C, Machine, S, recorded


def check_place(place: RackAlignment, own: Machine, line: Machine) -> None:
    """Check that the time of each tick is right within the uncertainty."""
    ticks = np.arange(0, TICKS, 7)
    found = place.convert_ticks(ticks, 0)
    true = [line.shows(own.true_ns(int(tick))) - line.epoch_ns for tick in ticks]
    apart_ns = np.abs(found - np.array(true) * line.speed)
    assert apart_ns.max() <= place.uncertainty_ns * line.speed + MS // 1000
    # The uncertainty covers only the error of a comparison and the drift between comparisons.
    assert place.uncertainty_ns <= (ERROR_NS + 7 * S * DRIFT_PPM // 1_000_000) * (
        place.shift is not None
    )


@pytest.mark.parametrize("seen_by", ["first", "second", "both"])
def test_a_rack_is_on_the_line_of_another_within_the_stated_uncertainty(
    tmp_path: Path, seen_by: str
) -> None:
    one = recorded(A, [B] if seen_by != "second" else [], tmp_path / "a")
    other = recorded(B, [A] if seen_by != "first" else [], tmp_path / "b", seed=2)
    first, second = align_racks([one, other])
    check_place(second, B, A)
    assert (first.convert_ticks(np.arange(TICKS), 5) == np.arange(TICKS) * CLOCK_NS + 5).all()
    assert first.uncertainty_ns == 0
    # The other rack's wall clock does not count, because it may be wrong.
    stamps = np.array([B.shows(3 * S)])
    assert (
        second.convert_to_wall_clock(stamps)[0]
        - first.convert_to_wall_clock(np.array([A.shows(3 * S)]))[0]
        <= second.uncertainty_ns
    )


def test_racks_that_never_met_the_first_one_are_refused(tmp_path: Path) -> None:
    a, b = recorded(A, [], tmp_path / "a"), recorded(B, [A, C], tmp_path / "b")
    c = recorded(C, [], tmp_path / "c")
    places = align_racks([b, a, c])
    check_place(places[1], A, B)
    check_place(places[2], C, B)
    with pytest.raises(Failure, match=r"rack 'c' and 'a' never met: no recording holds"):
        align_racks([a, b, c])


def test_another_launch_of_a_rack_is_refused(tmp_path: Path) -> None:
    one = recorded(A, [B], tmp_path / "a")
    later = recorded(replace(B, begins_ns=B.begins_ns + 60 * S), [], tmp_path / "b")
    why = r"not of the same run: 'a' met a launch of 'b' that began 60\.00\d s earlier"
    assert re.search(why, read_failure(align_racks, [one, later]))


def test_one_rack_twice_and_two_modes_are_refused(tmp_path: Path) -> None:
    one = recorded(A, [B], tmp_path / "a")
    with pytest.raises(Failure, match="both are of rack 'a'"):
        align_racks([one, one])
    stepped = recorded(replace(B, mode="lockstep"), [A], tmp_path / "b")
    with pytest.raises(Failure, match=r"b ran in lockstep, .*a in real time"):
        align_racks([one, stepped])
