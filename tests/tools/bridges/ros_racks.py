"""Racks that run beside another node of ROS 2, in lockstep and held, so that a test steps them."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rack.backplane.segment import Segment, list_racks
from rack.backplane.words import System
from tests.processes import RACK, children_of, wait_until
from tests.tools.command_line import BOUND_S, rack
from tests.warm import Popen

FOLDER = Path(__file__).parent
LOOPBACK = """
<CycloneDDS><Domain>
  <General>
    <Interfaces><NetworkInterface address="127.0.0.1" multicast="false"/></Interfaces>
  </General>
  <Discovery>
    <ParticipantIndex>auto</ParticipantIndex><Peers><Peer address="127.0.0.1"/></Peers>
  </Discovery>
</Domain></CycloneDDS>
"""


@dataclass
class Peer:
    """Another node. `ask` sends it a request and returns its answer."""

    process: subprocess.Popen[str]
    environment: Mapping[str, str]

    def ask(self, do: str, **request: Any) -> Any:
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        self.process.stdin.write(json.dumps({"do": do, **request}) + "\n")
        self.process.stdin.flush()
        return json.loads(self.process.stdout.readline())


@contextmanager
def ros_peer(folder: Path) -> Iterator[Peer]:
    """Start another node, to which nodes with the yielded environment connect."""
    place = f"unixsock-stream/{folder}/peer"
    config = folder / "zenoh.json5"
    settings = {
        "connect": {"endpoints": [place], "timeout_ms": -1, "exit_on_failure": False},
        "scouting": {"multicast": {"enabled": False}},
    }
    config.write_text(json.dumps(settings))
    environment = {"ZENOH_SESSION_CONFIG_URI": str(config), "ROS_DOMAIN_ID": "42"}
    with _peer("ros_peer.py", [place], environment) as peer:
        yield peer


@contextmanager
def dds_peer() -> Iterator[Peer]:
    """Start another node with DDS, to which nodes with the yielded environment connect."""
    environment = {
        "CYCLONEDDS_URI": LOOPBACK,
        "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp",
        # Other tests of this machine use other domains.
        "ROS_DOMAIN_ID": str(os.getpid() % 200 + 10),
    }
    with _peer("dds_peer.py", [], environment) as peer:
        yield peer


@contextmanager
def _peer(script: str, words: Sequence[str], environment: Mapping[str, str]) -> Iterator[Peer]:
    """Run a node in a process of its own."""
    command = [sys.executable, FOLDER / script, *words]
    pipe = subprocess.PIPE
    with subprocess.Popen(
        command, stdin=pipe, stdout=pipe, text=True, env={**os.environ, **environment}
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == '{"open": true}\n'
            yield Peer(process, environment)
        finally:
            process.kill()


@dataclass
class HeldRack:
    """A rack that is held in lockstep. `step` lets it run for some ticks."""

    name: str
    segment: Segment
    launcher: int
    log: Path

    def step(self, ticks: int) -> None:
        done = rack("step", self.name, "--ticks", ticks)
        assert done.returncode == 0, done.stderr

    def find_bridge(self) -> int:
        """Return the process of the bridge."""
        (found,) = [
            pid
            for pid in children_of(self.launcher)
            if b"\0bridge\0" in Path(f"/proc/{pid}/cmdline").read_bytes()
        ]
        return found

    def wait_for(self, text: str) -> None:
        """Wait until the run has printed a text."""
        wait_until(lambda: text in self.log.read_text(), BOUND_S)


@contextmanager
def held_rack(
    folder: Path, name: str, words: Sequence[object], environment: Mapping[str, str]
) -> Iterator[HeldRack]:
    """Run a rack that is held before its first tick, with the bridges that `words` ask for."""
    log = folder / f"{name}.log"
    command = [*RACK, "run", *map(str, words), "--lockstep", "--step", "--set", f"name={name}"]
    with (
        log.open("w") as output,
        Popen(command, stdout=output, stderr=output, env={**os.environ, **environment}) as process,
    ):
        try:
            wait_until(lambda: name in list_racks() or process.poll() is not None, BOUND_S)
            assert process.poll() is None, log.read_text()
            segment = Segment.attach(name)
            wait_until(lambda: segment.words[System.HELD], BOUND_S)
            yield HeldRack(name, segment, process.pid, log)
            segment.close()
            rack("stop", name)
            process.wait(BOUND_S)
        finally:
            process.kill()
