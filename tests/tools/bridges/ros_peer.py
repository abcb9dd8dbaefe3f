"""Another node of ROS 2, in a process of its own: zenoh and ros2-pyterfaces, no code of ours.

It reads a line of JSON for each request, and prints one for each answer.
"""

import json
import os
import struct
import sys
import time
from dataclasses import asdict, dataclass, field
from typing import Any

import zenoh
from ros2_pyterfaces.cyclone import idl
from ros2_pyterfaces.cyclone.builtin_interfaces.msg import Duration
from ros2_pyterfaces.cyclone.diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from ros2_pyterfaces.cyclone.geometry_msgs.msg import TransformStamped
from ros2_pyterfaces.cyclone.sensor_msgs.msg import JointState
from ros2_pyterfaces.cyclone.std_srvs.srv import Trigger, Trigger_Request, Trigger_Response
from ros2_pyterfaces.cyclone.trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint


@dataclass
class TFMessage(idl.IdlStruct, typename="tf2_msgs/msg/TFMessage"):
    """The only message here that ros2-pyterfaces does not have."""

    transforms: idl.types.sequence[TransformStamped] = field(default_factory=list)


KINDS = {
    kind.get_type_name(): kind
    for kind in (DiagnosticArray, DiagnosticStatus, JointState, TFMessage)
}
ATTACHMENT = struct.pack("<qqB16s", 7, 1, 16, bytes(range(16)))


def key_of(topic: str, kind: Any) -> str:
    """Return the key of a topic, as rmw_zenoh makes it, with the hash of ros2-pyterfaces."""
    package, group, name = kind.get_type_name().split("/")
    return f"42{topic}/{package}::{group}::dds_::{name}_/{kind.hash_rihs01()}"


def main() -> None:
    """Answer requests until stdin closes."""
    config = zenoh.Config()
    settings = {
        "mode": "peer",
        "listen/endpoints": [sys.argv[1]],
        "scouting/multicast/enabled": False,
        "transport/shared_memory/enabled": False,
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    session = zenoh.open(config)
    tokens = session.liveliness().declare_subscriber(
        "@ros2_lv/42/**", zenoh.handlers.RingChannel(1000), history=True
    )
    topics = session.declare_subscriber("42/**", zenoh.handlers.RingChannel(10_000))
    trajectory = session.declare_publisher(key_of("/joint_trajectory", JointTrajectory))
    write({"open": True})
    for line in sys.stdin:
        request = json.loads(line)
        answer: Any = None
        match request["do"]:
            case "tokens":
                answer = [[str(t.key_expr), t.kind == zenoh.SampleKind.PUT] for t in drain(tokens)]
            case "samples":
                found = drain(topics)
                answer = [describe(s) for s in found if "/joint_trajectory/" not in str(s.key_expr)]
            case "stop":
                replies = session.get(
                    key_of("/rack/emergency_stop", Trigger),
                    payload=Trigger_Request().serialize(),
                    attachment=ATTACHMENT,
                    target=zenoh.QueryTarget.ALL_COMPLETE,
                    timeout=20,
                )
                answer = [
                    [
                        asdict(Trigger_Response.deserialize(reply.ok.payload.to_bytes())),
                        reply.ok.attachment.to_bytes().hex(),
                    ]
                    for reply in replies
                ]
            case "is_followed":
                answer = trajectory.matching_status.matching
            case "move":
                points = [
                    JointTrajectoryPoint(
                        positions=positions, time_from_start=Duration(int(at), int(at % 1 * 1e9))
                    )
                    for at, positions in request["points"]
                ]
                message = JointTrajectory(joint_names=request["joints"], points=points)
                trajectory.put(message.serialize(), attachment=ATTACHMENT)
            case "put":
                key = request.get("key") or key_of("/joint_trajectory", JointTrajectory)
                for _ in range(request.get("times", 1)):
                    session.put(key, bytes.fromhex(request["hex"]), attachment=ATTACHMENT)
        write(answer)
    os._exit(0)


def write(answer: Any) -> None:
    """Write an answer."""
    sys.stdout.write(json.dumps(answer) + "\n")
    sys.stdout.flush()


def drain(channel: Any) -> list[Any]:
    """Return what waits in a channel."""
    # Tests ask again until they have what they expect. This only sets the pace.
    time.sleep(0.01)
    found = []
    while (item := channel.try_recv()) is not None:
        found.append(item)
    return found


def describe(sample: Any) -> Any:
    """Decode a sample by the type in its key, and say whether its key has the type's hash."""
    key = str(sample.key_expr)
    topic, wire, digest = key.removeprefix("42").rsplit("/", 2)
    name = wire.replace("::dds_::", "/").replace("::", "/").removesuffix("_")
    number, stamp_ns, length = struct.unpack("<qqB", sample.attachment.to_bytes()[:17])
    kind = KINDS[name]
    message = kind.deserialize(sample.payload.to_bytes())
    return {
        "topic": topic,
        "type": name,
        "has_hash": digest == kind.hash_rihs01(),
        "number": number,
        "age_s": time.time() - stamp_ns * 1e-9,
        "gid": sample.attachment.to_bytes()[17:].hex(),
        "length": length,
        "message": asdict(message),
    }


if __name__ == "__main__":
    main()
