"""A rack on the wire of DDS, seen by cyclonedds with types of its own, in another process."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rack.backplane.lines import UtilityLines
from rack.tools.monitor.newest_messages import NewestMessages
from tests.processes import runs, wait_until
from tests.tools.bridges.ros_racks import HeldRack, Peer, dds_peer, held_rack
from tests.tools.command_line import BOUND_S, rack, read_answer, read_refusal

pytest.importorskip("cyclonedds", reason="cyclonedds has no wheel for this Python")
pytestmark = pytest.mark.thorough
PUMA = ["j1", "j2", "j3", "j4", "j5", "j6"]
WORDS = ("chimera", "--set", "host.command.external=true", "--ros2", "--no-record")


@pytest.fixture(scope="module")
def peer() -> Iterator[Peer]:
    with dds_peer() as peer:
        yield peer


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory, peer: Peer) -> Iterator[HeldRack]:
    """A rack that follows trajectories."""
    folder = tmp_path_factory.mktemp("arm")
    with held_rack(folder, f"test-dds-{os.getpid()}", WORDS, peer.environment) as held:
        held.wait_for(f"rmw_cyclonedds_cpp, domain {peer.environment['ROS_DOMAIN_ID']}: ")
        yield held


def test_another_program_receives_the_topics_with_its_own_types(arm: HeldRack, peer: Peer) -> None:
    found: dict[str, Any] = {}
    for _ in range(100):
        arm.step(50)
        found |= {sample["topic"]: sample["message"] for sample in peer.ask("samples")}
        if len(found) == 3:
            break
    assert found.keys() == {"/joint_states", "/diagnostics", "/rack/servo/status"}
    joints = found["/joint_states"]
    assert joints["name"] == [*PUMA, "finger_left"]
    assert {len(joints[name]) for name in ("position", "velocity", "effort")} == {7}
    assert joints["position"][1] != 0.0
    assert found["/rack/servo/status"]["name"] == f"{arm.name}: servo"
    assert found["/diagnostics"]["status"][0]["hardware_id"] == arm.name


def test_trajectories_move_the_arm_and_other_types_are_reported(arm: HeldRack, peer: Peer) -> None:
    wait_until(lambda: peer.ask("is_followed"), BOUND_S)
    goal = [0.3, 1.1, -2.7, 0.1, -1.3, 0.2]
    peer.ask("move", joints=PUMA, points=[(0.5, goal)], times=1)
    newest = NewestMessages(arm.segment)

    def has_arrived() -> bool:
        arm.step(200)
        status: Any = newest.read_message("trajectory.status")
        return status is not None and status.position.tolist() == pytest.approx(goal, abs=1e-6)

    wait_until(has_arrived, BOUND_S)
    peer.ask("move", joints=["elbow"], points=[], times=2000)
    arm.wait_for('/joint_trajectory: joint_names = "elbow": must be j1, j2')
    assert arm.log.read_text().count('"elbow"') <= 5
    peer.ask("publish_old")
    arm.wait_for(
        "of another type or version: trajectory_msgs::msg::dds_::JointTrajectory_ typehash="
    )
    assert runs(arm.find_bridge())


def test_a_service_call_stops_the_arm_and_is_answered(arm: HeldRack, peer: Peer) -> None:
    lines = UtilityLines(arm.segment)
    wait_until(lambda: peer.ask("is_served"), BOUND_S)
    assert not lines.emergency_stop
    reply = peer.ask("stop")
    assert lines.emergency_stop
    assert (reply["guid"], reply["seq"], reply["success"]) == (2**63 + 5, 7, True)
    assert rack("estop", arm.name, "--reset").returncode == 0


def test_a_subscriber_that_stands_still_or_dies_delays_nobody(arm: HeldRack, peer: Peer) -> None:
    os.kill(peer.process.pid, signal.SIGSTOP)
    arm.step(2000)
    assert runs(arm.find_bridge())
    peer.process.kill()
    arm.step(200)
    assert runs(arm.find_bridge())


def test_an_unknown_transport_is_refused(
    arm: HeldRack, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp")
    valid = "must be rmw_zenoh_cpp or rmw_cyclonedds_cpp"
    refusal = read_refusal(rack("bridge", arm.name, "ros2"))
    assert refusal == f"RMW_IMPLEMENTATION = rmw_fastrtps_cpp: {valid}"


def test_a_rack_with_a_bridge_has_the_same_digest(
    peer: Peer, rack_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in peer.environment.items():
        monkeypatch.setenv(name, value)
    words = ("nasrem", "--lockstep", "--seconds", "0.5", "--no-record", f"--set=name={rack_name}")
    bridged, plain = read_answer("run", *words, "--ros2"), read_answer("run", *words)
    assert bridged["outcome"]["digest"] == plain["outcome"]["digest"]
