"""Which cycle broke which equation, and who had its core: on traces that are made up to break
them."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.backplane.trace import SKIPPED_SHIFT, Flag
from rack.boards.config import RackConfig, load, rack_timing
from rack.tools.recording.cycles import cycles_of
from rack.tools.timing.analysis.breaches import BEFORE, Breach, breaches
from tests.tools.recordings import MS, Cycle, recorded

PLANNED, MISSED, SKIPPED = int(Flag.PLANNED), int(Flag.MISSED), int(Flag.SKIPPED)
SETTLED = 40
PLAIN = (0.0, 0.1, 1.0, 0.1)


@pytest.fixture
def config(small: Path) -> RackConfig:
    """Two levels on one core: the upper every 20 ms, the lower every 2.5 ms with a planner that has
    4 of its cycles."""
    settings = ["clock.mode=realtime", "board.lower.priority=80", "board.upper.priority=70"]
    return load(small, [*settings, "timing.context_switch_ms=0.1"])


def found_in(folder: Path, config: RackConfig, traces: dict[str, list[Cycle]]) -> list[Breach]:
    recording = recorded(folder, config, traces)
    return breaches(cycles_of(recording), rack_timing(config, recording.layout))


def equations(breach: Breach) -> list[str]:
    return [broken.equation for broken in breach.broken]


def lower(count: int = 8) -> list[Cycle]:
    """Cycles of the lower level that fit."""
    return [Cycle(SETTLED + k, PLAIN) for k in range(count)]


def test_a_run_that_fits_breaks_nothing(config: RackConfig, tmp_path: Path) -> None:
    plan = Cycle(SETTLED, (0.0, 0.1, 4.0, 0.1), late=1.2, processor=1.8, flags=PLANNED)
    assert not found_in(tmp_path / "run", config, {"lower": lower(), "lower.planner": [plan]})


def test_a_cycle_that_computes_beyond_its_cycle_breaks_what_it_breaks(
    config: RackConfig, tmp_path: Path
) -> None:
    trace = [*lower(), Cycle(SETTLED + 8, (0.0, 0.1, 3.0, 0.1), flags=MISSED)]
    (breach,) = found_in(tmp_path / "run", config, {"lower": trace})
    assert (breach.task, breach.tick, breach.is_judged) == ("lower", SETTLED + 8, True)
    assert equations(breach) == ["3.1", "3.6", "3.9", "response time"]
    sides = {broken.equation: (broken.left, broken.sign, broken.right) for broken in breach.broken}
    assert sides["3.1"] == (3.2 * MS, "<=", 2.5 * MS)
    assert sides["3.6"] == (0, "<", pytest.approx(-0.7 * MS))
    # Two context switches more.
    assert sides["3.9"] == (pytest.approx(3.4 * MS), "<", 2.5 * MS)
    assert breach.sharing.text() == "computed 3.2 ms, usually 1.2 ms"


def test_the_worst_come_first_and_the_start_up_is_told_apart(
    config: RackConfig, tmp_path: Path
) -> None:
    bad = [Cycle(tick, (0.0, 0.1, ms, 0.1)) for tick, ms in ((3, 9.0), (50, 4.0), (60, 7.0))]
    found = found_in(tmp_path / "run", config, {"lower": [bad[0], *lower(), *bad[1:]]})
    assert [(breach.tick, breach.is_judged) for breach in found] == [
        (3, False),
        (60, True),
        (50, True),
    ]


def test_a_level_that_others_kept_from_its_core_keeps_its_own_equations(
    config: RackConfig, tmp_path: Path
) -> None:
    # Cycles of the lower level, of higher priority, follow one another for 21 ms: the upper one
    # ends too late.
    busy = [Cycle(SETTLED + k, (0.0, 0.1, 2.2, 0.1)) for k in range(9)]
    upper = Cycle(SETTLED, (0.0, 0.1, 20.9, 0.1), late=2.4, processor=1.2, flags=MISSED)
    found = found_in(tmp_path / "run", config, {"upper": [upper], "lower": busy})
    (breach,) = [breach for breach in found if breach.task == "upper"]
    assert equations(breach) == ["response time"]
    assert breach.sharing.own_ns <= 1.2 * MS
    assert breach.sharing.others_ns["lower"] == pytest.approx(9 * 2.4 * MS, rel=0.01)
    assert breach.sharing.text().startswith("lower had the core for 21.6 ms")


def test_time_that_no_trace_accounts_for_is_nobodys(config: RackConfig, tmp_path: Path) -> None:
    trace = [*lower(), Cycle(SETTLED + 8, PLAIN, late=9.0, flags=MISSED)]
    (breach,) = found_in(tmp_path / "run", config, {"lower": trace})
    assert equations(breach) == ["response time"]
    assert breach.sharing.nobody_ns == 9 * MS
    assert breach.sharing.text() == "no task of the rack had the core for 9 ms"


def test_a_cycle_that_is_late_since_the_one_before_still_lasted_says_so(
    config: RackConfig, tmp_path: Path
) -> None:
    long, late = Cycle(SETTLED + 8, (0.0, 0.1, 4.0, 0.1)), Cycle(SETTLED + 9, PLAIN, late=1.7)
    found = {
        b.tick: b for b in found_in(tmp_path / "run", config, {"lower": [*lower(), long, late]})
    }
    assert equations(found[SETTLED + 9]) == ["response time"]
    assert found[SETTLED + 9].sharing.others_ns == {BEFORE: 1.7 * MS}


def test_skipped_releases_are_steps_off_the_grid(config: RackConfig, tmp_path: Path) -> None:
    flags = SKIPPED | 3 << SKIPPED_SHIFT
    trace = [
        *lower(),
        Cycle(SETTLED + 11, PLAIN, late=0.2, flags=flags),
        Cycle(SETTLED + 15, PLAIN),
    ]
    (breach,) = found_in(tmp_path / "run", config, {"lower": trace})
    # Before the last one rows were lost, but no cycle was.
    assert (breach.tick, equations(breach)) == (SETTLED + 11, ["3.7"])
    assert (breach.broken[0].left, breach.broken[0].right) == (10 * MS, 2.5 * MS)
    assert breach.sharing.lasted_ns == (3 * 2.5 + 0.2 + 1.2) * MS


def test_a_plan_is_held_against_what_its_own_cycles_left(
    config: RackConfig, tmp_path: Path
) -> None:
    # 2.5 - 1.2 - 2 t_cs leaves 1.1 ms a cycle, 4.4 ms in four.
    fits = Cycle(SETTLED, (0.0, 0.0, 8.0, 0.1), late=1.2, processor=4.3, flags=PLANNED)
    too_long = Cycle(SETTLED + 4, (0.0, 0.0, 8.0, 0.1), late=1.2, processor=4.6, flags=PLANNED)
    found = found_in(
        tmp_path / "run", config, {"lower": lower(), "lower.planner": [fits, too_long]}
    )
    (breach,) = [breach for breach in found if breach.task == "lower.planner"]
    assert (breach.tick, equations(breach)) == (SETTLED + 4, ["3.8"])
    assert breach.broken[0].right == pytest.approx(1.1 * MS)


def test_the_update_of_a_plan_counts_in_the_cycle_in_which_it_came(
    config: RackConfig, tmp_path: Path
) -> None:
    plan = Cycle(SETTLED, (0.0, 0.0, 2.6, 0.5), late=1.2, processor=1.9, flags=PLANNED)
    found = found_in(tmp_path / "run", config, {"lower": lower(), "lower.planner": [plan]})
    (breach,) = [breach for breach in found if breach.task == "lower"]
    assert (breach.tick, equations(breach), breach.broken[0].unit) == (SETTLED + 1, ["3.10"], "1")
    assert breach.broken[0].left == pytest.approx(0.2, abs=0.001)


def test_lockstep_knows_no_deadline(config: RackConfig, small: Path, tmp_path: Path) -> None:
    trace = [*lower(), Cycle(SETTLED + 8, PLAIN, late=9.0)]
    assert not found_in(tmp_path / "run", load(small, ["clock.mode=lockstep"]), {"lower": trace})
