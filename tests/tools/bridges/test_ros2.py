"""A rack on the wire of ROS 2, seen by an independent node: zenoh, and ros2-pyterfaces for CDR."""

from __future__ import annotations

import json
import os
import re
import signal
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from rack.backplane.lines import UtilityLines
from rack.backplane.segment import list_racks
from rack.tools.monitor.newest_messages import NewestMessages
from tests.pages import ROOT
from tests.processes import runs, wait_until
from tests.tools.bridges.ros_racks import HeldRack, Peer, held_rack, ros_peer
from tests.tools.command_line import BOUND_S, read_answer

pytestmark = pytest.mark.slow
PUMA = ["j1", "j2", "j3", "j4", "j5", "j6"]
PAGE = ROOT / "tools" / "NEIGHBOURS.md"
OTHER = "42/joint_trajectory/trajectory_msgs::msg::dds_::JointTrajectory_/RIHS01_00"
EXTERNAL = ("chimera", "--set", "host.command.external=true", "--ros2")


@pytest.fixture(scope="module")
def peer(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Peer]:
    with ros_peer(tmp_path_factory.mktemp("peer")) as peer:
        yield peer


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory, peer: Peer) -> Iterator[HeldRack]:
    """The NASREM rack, which no trajectory may enter."""
    folder = tmp_path_factory.mktemp("arm")
    words = ("nasrem", "--ros2", "--no-record")
    with held_rack(folder, f"test-ros-{os.getpid()}", words, peer.environment) as held:
        yield held


def collect(peer: Peer, held: HeldRack, topics: set[str]) -> dict[str, list[Any]]:
    """Step the rack until the peer has got a message of each topic."""
    found = defaultdict(list)
    for _ in range(50):
        held.step(100)
        for sample in peer.ask("samples"):
            found[sample["topic"]].append(sample)
        if topics <= found.keys():
            return found
    raise TimeoutError(f"only {set(found)}")


def test_another_node_decodes_the_topics_of_a_rack(arm: HeldRack, peer: Peer) -> None:
    levels = ("servo", "primitive", "elemental_move", "task")
    statuses = {f"/rack/{level}/status" for level in levels}
    found = collect(peer, arm, {"/joint_states", "/tf", "/diagnostics", *statuses})
    for samples in found.values():
        assert all(sample["has_hash"] and sample["length"] == 16 for sample in samples)
        assert all(abs(sample["age_s"]) < 60 for sample in samples)
        numbers = [sample["number"] for sample in samples]
        assert numbers == list(range(numbers[0], numbers[0] + len(numbers)))
        assert len({sample["gid"] for sample in samples}) == 1
    joints = found["/joint_states"][-1]["message"]
    assert joints["name"] == [*PUMA, "finger_left"]
    # Until the rack is stepped again, its newest message is the last that was sent.
    wait_until(lambda: not peer.ask("samples"))
    servo = NewestMessages(arm.segment).read_message("servo.status")
    assert servo is not None
    stamp = joints["header"]["stamp"]
    assert stamp["sec"] + stamp["nanosec"] * 1e-9 <= arm.segment.words[1] * 10.0
    frames = {t["child_frame_id"] for t in found["/tf"][-1]["message"]["transforms"]}
    assert {"link1", "link6", "block1"} <= frames
    status = found["/rack/servo/status"][-1]["message"]
    assert (status["name"], status["level"]) == (f"{arm.name}: servo", 0)
    cycles = {
        entry["message"]["status"][0]["name"].removeprefix(f"{arm.name}: ")
        for entry in found["/diagnostics"]
    }
    assert {"servo", "primitive", "world"} <= cycles


def test_the_graph_shows_a_node_with_publishers_and_a_service(arm: HeldRack, peer: Peer) -> None:
    node = arm.name.replace("-", "_")
    other = [token for token, is_there in peer.ask("tokens") if is_there]
    parts = [token.split("/") for token in other]
    mine = [part for part in parts if part[8] == f"rack_{node}"]
    assert mine[0][5:] == ["NN", "%", "%", f"rack_{node}"]
    assert len({(part[3], part[4]) for part in mine}) == len(mine)
    by_kind = defaultdict(set)
    for part in mine[1:]:
        by_kind[part[5]].add(part[9])
        assert part[12] == "::,10:,:,:,,"
    assert by_kind["SS"] == {"%rack%emergency_stop"}
    assert {"%joint_states", "%tf", "%diagnostics", "%rack%servo%status"} <= by_kind["MP"]
    assert "MS" not in by_kind
    arm.wait_for("no /joint_trajectory: the rack has no external host board for motion requests")


def test_a_service_call_stops_the_arm(arm: HeldRack, peer: Peer) -> None:
    lines = UtilityLines(arm.segment)
    assert not lines.emergency_stop
    ((response, attachment),) = peer.ask("stop")
    assert response["success"]
    assert lines.emergency_stop
    # The reply carries the number and the GID of the request.
    assert (attachment[:16], attachment[32:]) == ("0700000000000000", "10" + bytes(range(16)).hex())
    arm.wait_for("/rack/emergency_stop: the emergency stop is set")


def test_a_killed_bridge_leaves_the_rack_unhurt(arm: HeldRack, peer: Peer) -> None:
    bridge = arm.find_bridge()
    os.kill(bridge, signal.SIGKILL)
    arm.wait_for(f"ended (signal SIGKILL); the rack goes on: rack bridge {arm.name} ros2")
    wait_until(lambda: not runs(bridge))
    # Zenoh can use segments of its own, which a killed process would leave behind.
    assert not [*Path("/dev/shm").glob("*zenoh*")]
    arm.step(40)
    assert [name for name in list_racks() if name.startswith(arm.name)] == [arm.name]
    wait_until(lambda: any(not is_there for _, is_there in peer.ask("tokens")), BOUND_S)


@pytest.mark.thorough
@pytest.mark.timeout(300)
def test_trajectories_move_an_arm_and_are_replayed_and_mistakes_are_one_line_each(
    peer: Peer, rack_name: str, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    # The message of the page, with a point before it, and with the joints in another order.
    (line,) = re.findall(r'ros2 topic pub .*JointTrajectory "(.*?)"', PAGE.read_text(), re.DOTALL)
    message = YAML(typ="safe").load(line)
    assert message["joint_names"] == PUMA
    (point,) = message["points"]
    goal = point["positions"]
    swapped = [*PUMA[:0:-1], PUMA[0]]
    last = point["time_from_start"]["sec"], [*goal[:0:-1], goal[0]]
    points = [(0.5, [0.1, -1.4, 0.05, -2.9, 1.3, 0.1]), last]
    with held_rack(tmp_path, rack_name, (*EXTERNAL, "--out", run), peer.environment) as held:
        wait_until(lambda: peer.ask("is_followed"), BOUND_S)
        peer.ask("put", hex="00010000ffffffffffffffff", times=2000)
        held.wait_for("/joint_trajectory: 12 bytes are not a trajectory_msgs/msg/JointTrajectory")
        assert held.log.read_text().count("12 bytes are not") <= 5
        peer.ask("move", joints=swapped, points=points)
        newest = NewestMessages(held.segment)
        steps = 0
        # The requests come from another process, at a tick that depends on its timing.
        while (status := newest.read_message("trajectory.status")) is None or status.done < 3:
            held.step(200)
            steps += 1
            assert steps < 40
        assert status.position.tolist() == pytest.approx(goal, abs=1e-6)
        mistakes: list[tuple[dict[str, Any], str]] = [
            ({"joints": ["elbow"], "points": []}, 'joint_names = "elbow": must be j1, j2'),
            (
                {"joints": PUMA, "points": [(1.0, [0.0])]},
                "points[0].positions has length 1: must be 6",
            ),
            ({"joints": PUMA, "points": [(1.0, goal), (1.0, goal)]}, "points[1].time_from_start"),
        ]
        for mistake, why in mistakes:
            insist(held, peer, f"ros2: /joint_trajectory: {why}", "move", **mistake)
        why = f"of another type or version: {OTHER}; valid: "
        insist(held, peer, why, "put", key=OTHER, hex="00")
        held.step(200)
        assert runs(held.find_bridge())
        assert newest.read_message("trajectory.status").done == status.done
    # A run that takes the messages of its host boards from the first one.
    outcome = json.loads((run / "report.json").read_text())["outcome"]
    words = ("--lockstep", "--entries", run, "--seconds", outcome["ticks"] * 0.002, "--no-record")
    repeated = read_answer("run", run / "config.toml", *words)
    assert repeated["outcome"]["digest"] == outcome["digest"]


def insist(held: HeldRack, peer: Peer, text: str, do: str, **request: Any) -> None:
    """Repeat a request until the run has printed a text: lines about a topic are a second apart."""

    def has_printed() -> bool:
        peer.ask(do, **request)
        return text in held.log.read_text()

    wait_until(has_printed, BOUND_S)
