"""Whatever a level leaves out, its arm reports: refusals, limits, contacts and brakes are events,
and counted."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import pytest

from rack.boards import Rack
from rack.tools.faults.ending import ArmEnd, read_arm
from tests.boards.conftest import MakeConfig
from tests.levels.arms import ROBOTS
from tests.tools.command_line import rack as rack_command

NAN = "nan"
POST = """
[[scene.motion]]
body = "post"
at = 0.0
to = [0.35, 0.85, 1.3]
speed = 50.0

[[scene.motion]]
body = "post"
at = 0.2
to = [0.35, -0.85, 1.3]
speed = 4.0
"""


def careless(params: str, more: str = "") -> str:
    """Return a rack whose only level drives an arm, as TOML."""
    return f"""
extends = ["{ROBOTS / "puma560_crossing.toml"}"]
format = 2
name = "careless"
python_path = ["{Path(__file__).parent}"]

[clock]
period_ms = 2.5
mode = "lockstep"

[board.servo]
slot = 2
core = 1
rate_hz = 400
executor = "careless_levels:Careless"
params = {{ {params} }}
{more}"""


class Case(NamedTuple):
    """What the level does; the detections by tick, code and subject; the times that brakes
    engage; and the first words of why the run fails, empty: it does not."""

    params: str
    found: Sequence[tuple[int, str, str]]
    brakings: int
    fault: str = ""


CASES = {
    "NaN in every second cycle": Case(
        f"torques = [{', '.join([NAN, '0.0'] * 5)}]", [(50, "command_invalid", "j3")], 5
    ),
    "NaN now and much later": Case(
        f"torques = [{', '.join([NAN, *['0.0'] * 30, NAN])}]",
        [(50, "command_invalid", "j3"), (81, "command_invalid", "j3")],
        2,
    ),
    "NaN throughout, so that the brakes are never released": Case(
        f"first = 0, torques = [{', '.join([NAN] * 160)}]",
        [(0, "command_invalid", "j3")],
        0,
        "held without a known cause, in 400 ms: brakes engaged 1 time",
    ),
    "a torque beyond its limit, and no state saved": Case(
        "torques = [1e4], saves = false", [(50, "command_limit", "j3")], 1
    ),
    "a limit of velocity broken, and no state saved": Case(
        "thrown = true, saves = false",
        [(50, "limit_exceeded", "j2")],
        0,
        "arm of 'servo': limits exceeded in ",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_an_arm_reports_by_itself_what_its_level_leaves_out(config: MakeConfig, name: str) -> None:
    case = CASES[name]
    with Rack(config(text=careless(case.params))) as rack:
        outcome = rack.run(0.4)
        events = rack.events
        arm = read_arm(rack.segment)
    found = [(e.tick, e.code, e.subject) for e in events if e.kind == "detection"]
    assert found == [*case.found]
    assert [braking.why for braking in outcome.brakings] == ["limit"] * case.brakings
    assert outcome.is_success == (not case.fault)
    assert [fault.startswith(case.fault) for fault in outcome.faults] == [True] * bool(case.fault)
    assert (arm.violations > 0) == ("limit_exceeded" in str(case.found))


@pytest.mark.slow
def test_an_arm_reports_a_blow_by_itself(config: MakeConfig) -> None:
    with Rack(config(text=careless("", POST))) as rack:
        outcome = rack.run(0.6)
        found = [event for event in rack.events if event.kind == "detection"]
        arm = read_arm(rack.segment)
    assert {event.code for event in found} >= {"collision"}
    assert "'post'" in found[0].text
    assert arm.touches > 0
    assert arm != ArmEnd()
    assert outcome.faults[0].endswith(f"{arm.touches} unintended contacts")


@pytest.mark.thorough
def test_the_command_and_its_report_say_that_torques_were_refused(
    tmp_path: Path, rack_name: str
) -> None:
    path = tmp_path / "careless.toml"
    path.write_text(careless(CASES["NaN in every second cycle"].params))
    out = tmp_path / "run"
    done = rack_command("run", path, "--set", f"name={rack_name}", "--seconds", 0.4, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "rejected: torque of j3 is NaN" in done.stderr
    report = json.loads((out / "report.json").read_text())
    assert report["motion"]["clipped_cycles"] == 5
    assert "\nbrakes    engaged 5 times" in done.stdout
    page = (out / "report.md").read_text()
    assert "commands refused or cut in 5 cycles" in page
    assert "brakes: engaged 5 times, " in page
    assert len(report["outcome"]["brakings"]) == 5
