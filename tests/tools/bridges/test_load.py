"""A bridge changes nothing in a rack."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.tools.bridges.ros_racks import dds_peer, ros_peer
from tests.tools.command_line import rack


@pytest.mark.slow
def test_a_rack_with_bridges_has_the_same_digest(
    rack_name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("nasrem", "--lockstep", "--seconds", "1", "--no-record", "--json")

    def run(*bridges: str, **settings: str) -> str:
        with monkeypatch.context() as patch:
            for name, value in settings.items():
                patch.setenv(name, value)
            done = rack("run", *words, *bridges, "--set", f"name={rack_name}")
        return str(json.loads(done.stdout)["outcome"]["digest"])

    with ros_peer(tmp_path) as peer, dds_peer() as other:
        digests = {
            run(),
            run("--ros2", "--foxglove", FOXGLOVE_PORT="0", **peer.environment),
            run("--ros2", **other.environment),
        }
        assert len(digests) == 1
        assert {sample["topic"] for sample in peer.ask("samples")} >= {"/joint_states", "/tf"}
