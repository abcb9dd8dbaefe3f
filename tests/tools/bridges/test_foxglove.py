"""A running rack in Foxglove: a websocket client connects, and decodes what it gets."""

from __future__ import annotations

import json
import os
import struct
import sys
from base64 import b64decode
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from websockets.sync.client import ClientConnection, connect

from rack.tools.ecosystem.ros_messages import STORE
from tests.processes import runs, wait_until
from tests.tools.bridges.ros_racks import HeldRack, held_rack
from tests.tools.command_line import rack, read_answer, read_refusal

pytestmark = pytest.mark.thorough
HEAD = struct.Struct("<BIQ")


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[HeldRack]:
    """A rack without the extra for ROS 2."""
    folder = tmp_path_factory.mktemp("shown")
    (folder / "zenoh.py").write_text("raise ModuleNotFoundError('gone', name='zenoh')")
    words = ("nasrem", "--ros2", "--foxglove", "--out", folder / "run")
    environment = {"FOXGLOVE_PORT": "0", "PYTHONPATH": str(folder)}
    with held_rack(folder, f"test-fox-{os.getpid()}", words, environment) as held:
        held.wait_for("in Foxglove")
        yield held
    # A bridge changes nothing.
    outcome = json.loads((folder / "run" / "report.json").read_text())["outcome"]
    plain = ("nasrem", "--lockstep", "--no-record", "--set", f"name={held.name}")
    seconds = outcome["ticks"] * held.segment.layout.clock_ns * 1e-9
    again = read_answer("run", *plain, "--seconds", seconds)
    assert again["outcome"]["digest"] == outcome["digest"]


class Client:
    """A client that has subscribed to all channels."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.channels: dict[str, Any] = {}
        self.messages: dict[str, list[bytes]] = {}
        self._topics: dict[int, str] = {}

    def receive(self, seconds: float = 0.2) -> None:
        """Take what comes until nothing has come for a while."""
        while True:
            try:
                data = self._socket.recv(timeout=seconds)
            except TimeoutError:
                return
            if isinstance(data, bytes):
                _, subscription, _ = HEAD.unpack_from(data)
                self.messages.setdefault(self._topics[subscription], []).append(data[HEAD.size :])
            elif (document := json.loads(data))["op"] == "advertise":
                new = document["channels"]
                self.channels |= {channel["topic"]: channel for channel in new}
                self._topics |= {channel["id"]: channel["topic"] for channel in new}
                wanted = [{"id": c["id"], "channelId": c["id"]} for c in new]
                self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def decode(self, topic: str) -> Any:
        """Decode the newest message of a topic as its channel says."""
        channel = self.channels[topic]
        data = self.messages[topic][-1]
        if channel["encoding"] == "json":
            return json.loads(data)
        if channel["encoding"] == "cdr":
            assert channel["schemaEncoding"] == "ros2msg"
            return STORE.deserialize_cdr(data, channel["schemaName"])
        files = FileDescriptorSet.FromString(b64decode(channel["schema"] + "=="))
        pool = DescriptorPool()
        for file in files.file:
            pool.Add(file)
        kind = GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))
        return kind.FromString(data)


def find_port(held: HeldRack) -> int:
    return int(held.log.read_text().partition("open ws://127.0.0.1:")[2].split()[0])


def connect_to(held: HeldRack, close_s: float = 10.0, most: int | None = None) -> ClientConnection:
    """Connect a client, which lays up at most so many messages that it has not read."""
    url = f"ws://127.0.0.1:{find_port(held)}"
    protocols: Any = ["foxglove.sdk.v1"]
    return connect(
        url, subprotocols=protocols, max_size=None, max_queue=most, close_timeout=close_s
    )


def test_a_client_gets_scene_curves_timing_and_log(shown: HeldRack) -> None:
    with connect_to(shown) as socket:
        client = Client(socket)
        wanted = {"/cell", "/tf", "/joint_states", "/rosout", "/timing/servo", "/diagnostics"}
        for _ in range(50):
            client.receive()
            if wanted <= client.messages.keys():
                break
            shown.step(100)
        assert wanted <= client.messages.keys()
        scene = client.decode("/cell")
        shapes = {
            field.name
            for entity in scene.entities
            for field, value in entity.ListFields()
            if field.name in ("cubes", "spheres", "cylinders", "triangles")
        }
        assert {"cubes", "cylinders"} <= shapes
        frames = {transform.child_frame_id for transform in client.decode("/tf").transforms}
        # Every moving geom has a frame.
        assert {entity.frame_id for entity in scene.entities} <= {*frames, "world"}
        assert client.decode("/joint_states").name[:2] == ["j1", "j2"]
        assert client.decode("/timing/servo")["response_ms"] > 0
        assert client.decode("/rosout").msg
        assert {"/rack/servo/status", "/timing/world"} <= client.channels.keys()


def test_clients_come_and_go_and_a_second_server_is_refused(shown: HeldRack) -> None:
    for _ in range(3):
        with connect_to(shown) as socket:
            client = Client(socket)
            client.receive()
            shown.step(40)
    # A client that subscribes and never reads delays nobody. It cannot be closed in order.
    with connect_to(shown, close_s=0.0, most=16) as socket:
        Client(socket).receive()
        shown.step(400)
    assert runs(shown.find_bridge())
    port = find_port(shown)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FOXGLOVE_PORT", str(port))
        done = rack("bridge", shown.name, "foxglove")
    assert read_refusal(done, status=1).startswith(f"FOXGLOVE_PORT = {port}: ")
    wait_until(lambda: runs(shown.find_bridge()))


OWN_BRIDGES = """
from rack.tools.bridges.bridge import RackBridge

class NoBridge: ...

class Failing(RackBridge):
    def __init__(self, segment, tell):
        raise KeyError("no such signal")

    def show_rows(self, ring, rows): ...
    def advance(self, tick): ...
    def close(self): ...
"""


def test_mistakes_are_one_line_each(
    shown: HeldRack, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_bridges.py").write_text(OWN_BRIDGES)
    monkeypatch.syspath_prepend(str(tmp_path))
    cases = {
        (("nowhere", "ros2"), ""): (1, "rack 'nowhere' does not exist"),
        ((shown.name, "ros1"), ""): (2, "known bridges: ros2, foxglove, or package.module:Class"),
        ((shown.name, "own_bridges:NoBridge"), ""): (2, "has no RackBridge named 'NoBridge'"),
        ((shown.name, "own_bridges:Failing"), ""): (1, "KeyError: 'no such signal'"),
        ((shown.name, "foxglove"), "FOXGLOVE_PORT=many"): (2, "FOXGLOVE_PORT = many: must be"),
        ((shown.name, "foxglove"), "FOXGLOVE_PORT=99999"): (2, "FOXGLOVE_PORT = 99999: must be"),
        ((shown.name, "ros2"), "ROS_DOMAIN_ID=300"): (2, "ROS_DOMAIN_ID = 300: must be from 0 to"),
        ((shown.name, "ros2"), "ZENOH_SESSION_CONFIG_URI=/missing.json5"): (1, "zenoh: "),
    }
    for (words, setting), (status, why) in cases.items():
        with monkeypatch.context() as patch:
            if setting:
                patch.setenv(*setting.split("="))
            done = rack("bridge", *words)
        assert why in read_refusal(done, status)


def test_a_missing_extra_is_named_and_the_rack_runs(
    shown: HeldRack, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown.step(5)
    shown.wait_for("ros2: zenoh is missing: pip install 'nasrem-rack[ros2]'")
    monkeypatch.setitem(sys.modules, "foxglove", None)
    monkeypatch.delitem(sys.modules, "rack.tools.bridges.foxglove", raising=False)
    refusal = read_refusal(rack("bridge", shown.name, "foxglove"), status=1)
    assert refusal == "foxglove is missing: pip install 'nasrem-rack[foxglove]'"
