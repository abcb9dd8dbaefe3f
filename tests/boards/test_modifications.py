"""Control modifications on real boards: switched at their ticks, without a step, and repeated bit
for bit."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from rack.backplane.mailbox.history import MailboxRing
from rack.boards import Rack
from rack.boards.config import load
from rack.boards.events import Event
from tests.boards.commanded_racks import commands
from tests.boards.config.mistakes import find_mistake
from tests.boards.conftest import format_board

pytestmark = pytest.mark.slow
JOINT_BOARDS = "rack.levels.systems.joint_boards"
SERVO = {"rate_hz": 1000, "above": "swing", "below": "arm"}
SHOULDER = {
    "joints": ["j1", "j2", "j3"],
    "modifications": {
        "pd": {"class": "rack.levels.servo.common_modifications:JointPd"},
        "lean": {"class": "joint_levels:Lean"},
        "breaks": {"class": "joint_levels:Breaks"},
    },
}
WRIST = {"joints": ["j4", "j5", "j6"], "gripper": True}
BOTH = ["shoulder", "wrist"]
TEXT = f"""
format = 2
name = "modified"
extends = ["robots/puma560.toml"]
python_path = ["{Path(__file__).parent}"]
robot.substeps = 2

[clock]
period_ms = 1.0
mode = "lockstep"

{format_board("arm", 2, f"{JOINT_BOARDS}:ArmExecutor", core=1, rate_hz=1000, above=BOTH)}
{format_board("shoulder", 3, f"{JOINT_BOARDS}:JointServo", **SERVO, params=SHOULDER)}
{format_board("wrist", 4, f"{JOINT_BOARDS}:JointServo", **SERVO, params=WRIST)}
{format_board("swing", 5, "joint_levels:Swing", rate_hz=50, below=BOTH)}
"""
SECONDS = 0.7
LARGEST_STEP = 1.5 / 50 * 4.0
"""N m: of a difference of 4 N m that decays in 50 ticks."""


def switch(name: str, is_on: bool, tick: int) -> str:
    return f"level='shoulder', what='modify', name='{name}', on={str(is_on).lower()}, tick={tick}"


SWITCHED = commands(
    switch("lean", True, 300),
    switch("lean", False, 400),
    switch("pd", True, 450),
    switch("breaks", True, 550),
)


class Ran(NamedTuple):
    """A run: its digest, its events, and the statuses of the board of the shoulder by tick."""

    digest: str
    events: list[Event]
    rows: np.ndarray

    def torque(self, tick: int) -> np.ndarray:
        """Return the board's torque of a cycle, N m."""
        return np.asarray(self.rows["message"]["torque"][self.rows["tick"] == tick][0])

    def reason(self, tick: int) -> str:
        """Return what its status says in a cycle."""
        return str(self.rows["message"]["reason"][self.rows["tick"] == tick][0].decode())


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Ran]:
    path = tmp_path_factory.mktemp("modified") / "modified.toml"
    path.write_text(TEXT)

    def run(*settings: str) -> Ran:
        with Rack(load(path, settings)) as rack:
            outcome = rack.run(SECONDS)
            return Ran(
                outcome.digest,
                rack.events,
                MailboxRing(rack.segment, "shoulder.status").read_new_rows().rows,
            )

    return run


@pytest.fixture(scope="module")
def switched(run: Callable[..., Ran]) -> Ran:
    return run(SWITCHED)


@pytest.fixture(scope="module")
def without(run: Callable[..., Ran]) -> Ran:
    return run("board.shoulder.params.modifications={}")


@pytest.mark.thorough
def test_a_modification_is_in_force_from_the_cycle_after_its_tick_without_a_step(
    switched: Ran, without: Ran
) -> None:
    for tick, reason in (
        (300, ""),
        (301, "modified by lean"),
        (400, "modified by lean"),
        (401, ""),
    ):
        assert switched.reason(tick) == reason
    for tick in (301, 401, 451):
        assert switched.torque(tick) == pytest.approx(switched.torque(tick - 1), abs=1e-12)
    steps, in_motion = (
        np.diff([ran.torque(tick) for tick in range(290, 450)], axis=0)
        for ran in (switched, without)
    )
    assert np.abs(steps).max() < np.abs(in_motion).max() + LARGEST_STEP


def test_a_run_with_switches_repeats_and_equals_an_unmodified_run_up_to_the_first_switch(
    switched: Ran, without: Ran, run: Callable[..., Ran]
) -> None:
    again = run(SWITCHED)
    assert again.digest == switched.digest != without.digest
    assert (again.rows["message"] == switched.rows["message"]).all()
    differs = [
        tick for tick in range(100, 400) if (without.torque(tick) != switched.torque(tick)).any()
    ]
    assert differs[0] == 301


def test_a_failed_modification_is_removed_with_its_reason_and_the_arm_continues(
    switched: Ran,
) -> None:
    assert switched.reason(649) == "modified by pd, breaks"
    assert (
        switched.reason(650)
        == "modification 'breaks' taken out: KeyError: 'nothing left'; modified by pd"
    )
    found = [event for event in switched.events if event.kind == "detection"]
    assert [(e.tick, e.board, e.subject, e.code) for e in found] == [
        (650, "shoulder", "breaks", "modification")
    ]
    assert found[0].text == "control modification 'breaks' failed and was taken out"
    assert not (switched.rows["message"]["stopped"][-50:]).any()


MISTAKES = {
    "no such class": (
        "modifications.pd.class=rack.levels.servo.common_modifications:Pd",
        "board.shoulder.params.modifications.pd.class = ",
        "has no class 'Pd'",
    ),
    "no suitable parameter": (
        "modifications.notch={class='rack.levels.servo.common_modifications:Notch',"
        " params={frequency=600.0}}",
        "board.shoulder.params.modifications.notch",
        "params.frequency = 600 Hz: must be below half the law's rate, 500 Hz",
    ),
}


@pytest.mark.parametrize(("setting", "place", "why"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_in_a_modification_is_one_line(
    write: Callable[[str, str], Path], setting: str, place: str, why: str
) -> None:
    found = find_mistake(write("modified.toml", TEXT), f"board.shoulder.params.{setting}")
    assert found.startswith(place)
    assert why in found
