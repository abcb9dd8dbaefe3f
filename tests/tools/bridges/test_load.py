"""A bridge changes nothing in a rack."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.tools.bridges.ros_racks import ros_peer
from tests.tools.command_line import rack


@pytest.mark.slow
def test_a_rack_with_bridges_has_the_same_digest(
    rack_name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("nasrem", "--lockstep", "--seconds", "2", "--no-record", "--json")
    with ros_peer(tmp_path) as peer:
        for name, value in {**peer.environment, "FOXGLOVE_PORT": "0"}.items():
            monkeypatch.setenv(name, value)
        digests = {}
        for bridges in ((), ("--ros2", "--foxglove")):
            done = rack("run", *words, *bridges, "--set", f"name={rack_name}")
            digests[bridges] = json.loads(done.stdout)["outcome"]["digest"]
        assert len({*digests.values()}) == 1
        assert {sample["topic"] for sample in peer.ask("samples")} >= {"/joint_states", "/tf"}
