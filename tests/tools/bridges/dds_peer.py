"""A node of ROS 2 with DDS, in a process of its own: cyclonedds and its own types, no code of ours.

It reads a line of JSON for each request, and prints one for each answer.
"""

import json
import os
import sys
import time
from dataclasses import asdict, dataclass
from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, types
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

RELIABLE = Policy.Reliability.Reliable(10**9)
CDR = Policy.DataRepresentation(use_cdrv0_representation=True)
Numbers = types.sequence[types.float64]


@dataclass
class Time(IdlStruct, typename="builtin_interfaces::msg::dds_::Time_"):
    sec: types.int32
    nanosec: types.uint32


@dataclass
class Duration(IdlStruct, typename="builtin_interfaces::msg::dds_::Duration_"):
    sec: types.int32
    nanosec: types.uint32


@dataclass
class Header(IdlStruct, typename="std_msgs::msg::dds_::Header_"):
    stamp: Time
    frame_id: str


@dataclass
class JointState(IdlStruct, typename="sensor_msgs::msg::dds_::JointState_"):
    header: Header
    name: types.sequence[str]
    position: Numbers
    velocity: Numbers
    effort: Numbers


@dataclass
class KeyValue(IdlStruct, typename="diagnostic_msgs::msg::dds_::KeyValue_"):
    key: str
    value: str


@dataclass
class Status(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticStatus_"):
    level: types.byte
    name: str
    message: str
    hardware_id: str
    values: types.sequence[KeyValue]


@dataclass
class Diagnostics(IdlStruct, typename="diagnostic_msgs::msg::dds_::DiagnosticArray_"):
    header: Header
    status: types.sequence[Status]


@dataclass
class Point(IdlStruct, typename="trajectory_msgs::msg::dds_::JointTrajectoryPoint_"):
    positions: Numbers
    velocities: Numbers
    accelerations: Numbers
    effort: Numbers
    time_from_start: Duration


@dataclass
class Trajectory(IdlStruct, typename="trajectory_msgs::msg::dds_::JointTrajectory_"):
    header: Header
    joint_names: types.sequence[str]
    points: types.sequence[Point]


@dataclass
class OldTrajectory(IdlStruct, typename="trajectory_msgs::msg::dds_::JointTrajectory_"):
    joint_names: types.sequence[str]


@dataclass
class Request(IdlStruct, typename="std_srvs::srv::dds_::Trigger_Request_"):
    guid: types.uint64
    seq: types.int64
    structure_needs_at_least_one_member: types.uint8


@dataclass
class Response(IdlStruct, typename="std_srvs::srv::dds_::Trigger_Response_"):
    guid: types.uint64
    seq: types.int64
    success: bool
    message: str


TOPICS = {
    "/joint_states": JointState,
    "/diagnostics": Diagnostics,
    "/rack/servo/status": Status,
}


def main() -> None:
    """Answer requests until stdin closes."""
    participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))

    def create(kind: Any, topic: str, of_type: Any, *policies: Any) -> Any:
        return kind(
            participant, Topic(participant, topic, of_type), qos=Qos(RELIABLE, CDR, *policies)
        )

    readers = {name: create(DataReader, f"rt{name}", kind) for name, kind in TOPICS.items()}
    requests = create(DataWriter, "rq/rack/emergency_stopRequest", Request)
    replies = create(DataReader, "rr/rack/emergency_stopReply", Response)
    trajectories = create(DataWriter, "rt/joint_trajectory", Trajectory)
    write({"open": True})
    for line in sys.stdin:
        request = json.loads(line)
        answer: Any = None
        match request["do"]:
            case "samples":
                # Tests ask again until they have what they expect. This only sets the pace.
                time.sleep(0.01)
                answer = [
                    {"topic": topic, "message": asdict(sample)}
                    for topic, reader in readers.items()
                    for sample in reader.take(100)
                    if isinstance(sample, TOPICS[topic])
                ]
            case "is_served":
                answer = bool(requests.matched_sub and replies.matched_pub)
            case "stop":
                requests.write(Request(2**63 + 5, 7, 0))
                answer = asdict(next(replies.take_iter(timeout=20 * 10**9)))
            case "is_followed":
                answer = bool(trajectories.matched_sub)
            case "move":
                header = Header(Time(0, 0), "")
                points = [
                    Point(at, [], [], [], Duration(int(when), int(when % 1 * 1e9)))
                    for when, at in request["points"]
                ]
                for _ in range(request["times"]):
                    trajectories.write(Trajectory(header, request["joints"], points))
            case "publish_old":
                old = Policy.Userdata(b"typehash=RIHS01_00;")
                create(DataWriter, "rt/joint_trajectory", OldTrajectory, old)
        write(answer)
    os._exit(0)


def write(answer: Any) -> None:
    """Write an answer."""
    sys.stdout.write(json.dumps(answer, default=str) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
