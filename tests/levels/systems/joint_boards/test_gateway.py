"""A gateway between a trajectory level and boards that servo joints."""

from __future__ import annotations

import numpy as np
import pytest
from pydantic import ValidationError

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import State
from rack.levels.level import Pace
from rack.levels.messages import Error
from rack.levels.robot.cell import compute_sizes
from rack.levels.systems.joint_boards.gateway import JointGateway, NetworkGatewayParams
from rack.levels.systems.joint_boards.messages import JointReference, JointStatus
from tests.levels.arms import cell, config, context

TICK_S = 0.001
PERIOD, EVERY, DELAY, MISSING = 10, 2, 2, 5
LATENCY = DELAY + 2 * EVERY
SPEED = 0.5
"""Velocity of every joint, rad/s."""
SIZES = compute_sizes(cell("puma560"))


class GatewayRig:
    """Runs a gateway; references of a steady motion come when those of a trajectory level do."""

    def __init__(self) -> None:
        paces = {"near": Pace(1, 1), "far": Pace(1, 1)}
        given = {"every": EVERY, "sizes": SIZES, "above": {"above": Pace(PERIOD, 1)}}
        given["params"] = {"delay": DELAY * TICK_S, "missing": MISSING}
        self.gateway = JointGateway(context("gateway", config("puma560"), **given, below=paces))
        self.statuses = {name: JointStatus.zeros(SIZES) for name in paces}
        for k, status in enumerate(self.statuses.values()):
            status.driven[k::2] = 1
            status.target[k::2] = 1.0 + k
        self.lost: set[str] = set()
        self.tick = 0
        self.made = -1  # tick of the newest reference read
        # Tick, due and position of the references given.
        self.given: list[tuple[int, int, float]] = []

    @property
    def status(self) -> JointStatus:
        return self.gateway.status

    def run(self, ticks: int, late: int = 0, missing: bool = False) -> None:
        """Run the motion up to a tick; references come `late` ticks late, or are `missing`."""
        for _ in range(ticks // EVERY):
            made = (self.tick - PERIOD - late) // PERIOD * PERIOD
            reference = JointReference.zeros(SIZES)
            is_new = made > self.made and made >= 0 and not missing
            if is_new:
                self.made = made
                reference.id, reference.due = made // PERIOD + 1, made + 2 * PERIOD
                reference.position, reference.velocity = SPEED * TICK_S * reference.due, SPEED
            command = Reading(reference, Verdict.NEW if is_new else Verdict.OLD)
            statuses = {
                name: Reading(status, Verdict.NEW, name in self.lost)
                for name, status in self.statuses.items()
            }
            before = self.gateway.command.due
            vars(self.gateway).update(above=command, statuses=statuses)
            self.gateway.process(self.tick)
            command = self.gateway.command
            if command.due != before:
                self.given.append((self.tick, command.due, float(command.position[0])))
            self.tick += EVERY


def test_references_are_passed_on_with_a_constant_delay_and_in_time() -> None:
    rig = GatewayRig()
    rig.run(200)
    ticks, dues, positions = zip(*rig.given, strict=True)
    assert np.diff(dues).tolist() == [PERIOD] * (len(dues) - 1)
    assert dues[0] == 2 * PERIOD + LATENCY
    moved = [position / (SPEED * TICK_S) for position in positions]
    assert [due - LATENCY for due in dues] == pytest.approx(moved)
    # Visible a cycle later, each comes before the one before it is due.
    assert all(tick + EVERY <= due for tick, due in zip(ticks[1:], dues, strict=False))


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, MISSING])
def test_missing_references_are_extrapolated_without_a_gap(count: int) -> None:
    rig = GatewayRig()
    rig.run(100)
    rig.run(count * PERIOD, missing=True)
    rig.run(100)
    assert np.diff([due for _, due, _ in rig.given]).tolist() == [PERIOD] * (len(rig.given) - 1)
    # At the speed of the newest: the motion was steady.
    wanted = [SPEED * TICK_S * (due - LATENCY) for _, due, _ in rig.given]
    assert [position for _, _, position in rig.given] == pytest.approx(wanted)


def test_after_too_many_missing_references_the_boards_hold_the_arm() -> None:
    rig = GatewayRig()
    # A level above that wants no motion is obeyed without extrapolation.
    rig.run(200, missing=True)
    assert (rig.given, rig.gateway.command.due, rig.status.reason) == ([], 0, "")
    rig.run(100)
    newest = rig.made + 2 * PERIOD + LATENCY
    rig.run(150, missing=True)
    assert [due for _, due, _ in rig.given[-2:]] == [newest + MISSING * PERIOD, 0]
    assert rig.status.state == State.HOLDING
    assert rig.status.reason == "no reference from 'above': held after 5 extrapolated"
    rig.run(50)
    assert rig.gateway.command.due > rig.tick
    assert rig.status.reason == ""


def test_the_boards_appear_as_one_after_the_delay() -> None:
    rig = GatewayRig()
    rig.run(50)
    far = rig.statuses["far"]
    far.stopped, far.reason, far.error = 1, "braked", Error.LIMIT
    rig.run(DELAY)
    assert not rig.status.stopped
    rig.run(EVERY)
    status = rig.status
    assert (status.stopped, status.reason, status.error) == (1, "braked", Error.LIMIT)
    assert status.driven.tolist() == [1] * 6
    assert status.target.tolist() == [1.0, 2.0] * 3
    rig.lost.add("near")
    rig.run(10)
    assert (rig.status.stopped, rig.status.state) == (1, State.HOLDING)
    assert rig.status.reason == "no status from 'near': waiting for its board"


@pytest.mark.parametrize(
    ("key", "most", "more"),
    [("delay", 1.0, 1.01), ("missing", 1000, 1001), ("period", 1.0, 1.01), ("tick", 1.0, 1.01)],
)
def test_the_parameters_of_the_link_are_limited(key: str, most: float, more: float) -> None:
    assert NetworkGatewayParams.model_validate({key: most})
    with pytest.raises(ValidationError, match=key):
        NetworkGatewayParams.model_validate({key: more})
