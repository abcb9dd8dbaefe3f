"""The figures of racks as tables: a theme each, and what is to be said of single racks."""

from __future__ import annotations

from dataclasses import replace

from rack.tools.lab.benches.harness import Absent
from rack.tools.lab.benches.systems.figures import RealTimeFigures, SystemFigures, SystemPrediction
from rack.tools.lab.benches.systems.hold import HoldResponse
from rack.tools.lab.benches.systems.kills import KillDetection, KilledBoards
from rack.tools.lab.benches.systems.motion import PosesRun, Stop
from rack.tools.lab.benches.systems.realtime import BusTraffic, PlanLatency
from rack.tools.lab.benches.systems.tables import Systems

PROMISED = SystemPrediction(
    ("top", "low"), 2, 0, 3, (50.0, 400.0), 20.0, 40.0, 22.5, 22.5, 40.0, {0: 0.5}, True
)
TIMES = {"min": 20.0, "p50": 22.5, "p99": 22.5, "p99_9": 22.5, "max": 25.0}
HOLD = HoldResponse("top", "acted on", 30.0, 42.5, 31.0)
RAN = RealTimeFigures(
    missed=0.002,
    late=0.0015,
    commanded="top",
    command_bound_ms=25.0,
    command_ms=TIMES,
    status_ms=TIMES,
    command_age_ms=TIMES,
    status_age_ms=TIMES,
    hold=HOLD,
    plans=(PlanLatency("top.planner", 3, TIMES, TIMES), PlanLatency("host", 2, TIMES, None)),
    bus={"top": BusTraffic(100.0, 2e4), "low": BusTraffic(800.0, 1e5)},
    loads={0: 0.4},
    board_loads={"top": 0.1, "low": 0.3},
)
KILLS = KilledBoards(
    (
        KillDetection("top", 0, None, ""),
        KillDetection("low", 1, 9, "top"),
        KillDetection("host", 0, 4, "low"),
    ),
    2.5,
    8.0,
    "",
)
POSES = PosesRun(
    0.5, 5.0, 0.1, 0.4, 0.2, 3, Stop("top", 0.8, 398.0), Stop("emergency stop", 0.8, None)
)
FOUND = SystemFigures("one", PROMISED, RAN, KILLS, POSES, "")


def _rows(found: Systems, rack: str) -> list[list[str]]:
    return [line.split() for line in found.lines() if line.startswith(f"{rack} ")]


def test_a_rack_has_a_row_in_the_table_of_each_theme() -> None:
    made, answered, stopped, first_plan, host, used, late, killed, moved = _rows(
        Systems((FOUND,), 1.0, ()), "one"
    )
    assert made == ["one", "2", "2", "0", "3", "1", "50", "400", "0.50", "yes"]
    spans = ["22.5/25"] * 2
    assert answered == ["one", "20", "40", "22.5", "25", "22.5/25", "40", "22.5/25", *spans]
    assert stopped == ["one", "top", "30.0", "42.5", "top", "0.80", "398", "-"]
    assert first_plan == ["one", "top.planner", "3", "22.5", "25.0", "22.5", "25.0"]
    assert host == ["one", "host", "2", "22.5", "25.0", "-", "-"]
    assert used == ["one", "900", "120", "low", "800", "100", "0.40", "0.40", "low", "0.30"]
    assert late == ["one", "400", "0.20", "0.15", "0.05"]
    assert " ".join(killed) == "one 8x 3 0 .. 1 4 .. 9 10 .. 22.5 host low low top 1"
    assert moved == ["one", "0.50", "5.00", "0.100", "0.400", "0.200", "3"]


def test_what_a_rack_lacks_is_shown_as_such() -> None:
    still = replace(
        RAN, commanded="", command_bound_ms=None, command_ms=None, hold=None, plans=(), late=None
    )
    none = replace(
        FOUND,
        rack="none",
        predicted=replace(PROMISED, levels=(), rates_hz=()),
        realtime=still,
        poses=None,
    )
    lines = list(
        Systems(
            (FOUND, none), 1.0, (Absent("cyclictest", "no program", "apt-get install rt-tests"),)
        ).lines()
    )
    assert "one: top > low" in lines
    assert "none: no level above another" in lines
    assert "no plan made in the run: none" in lines
    assert "one: 4 ticks: host; 9 ticks: low; unnoticed: top" in lines
    *_, moved = [line.split() for line in lines if line.startswith("none ")]
    assert moved == ["none", "no", "PUMA", *["-"] * 5]
    assert lines[-1].startswith("absent: cyclictest")


def test_no_line_is_wider_than_a_page() -> None:
    long = replace(
        FOUND, rack="nist-state-table", predicted=replace(PROMISED, rates_hz=(50.0, 50.0, 400.0))
    )
    assert max(map(len, Systems((FOUND, long), 10.0, ()).lines(120))) <= 120


def test_a_rack_fails_by_its_run_and_a_late_hold_is_named() -> None:
    failed = replace(FOUND, failure="board lost: servo")
    late = replace(FOUND, rack="late", realtime=replace(RAN, hold=replace(HOLD, measured_ms=45.0)))
    overtaken = replace(
        FOUND, realtime=replace(RAN, hold=replace(HOLD, fate="overtaken", measured_ms=None))
    )
    assert Systems((FOUND, late, overtaken), 1.0, ()).worked
    assert not Systems((FOUND, failed), 1.0, ()).worked
    assert list(Systems((FOUND, failed), 1.0, ()).lines())[-1] == "one: board lost: servo"
    *_, last = Systems((FOUND, late), 1.0, ()).lines()
    assert last == "late: the response to the hold took longer than the longest on the grid"
    queued = replace(FOUND, realtime=replace(RAN, commanded="low"))
    below = (
        "one: down is measured from low: the wait in the queue above it does not count as response"
    )
    assert below in Systems((queued,), 1.0, ()).lines()
    assert any("overtaken" in line for line in Systems((overtaken,), 1.0, ()).lines())
    assert RAN.held
    assert replace(RAN, missed=0.02).verdict == "1.85 % missed beyond cyclictest"
