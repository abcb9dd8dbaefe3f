"""The page of the cell is true: its commands run as they stand there, each rack to the end of the
hand-over."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
from pathlib import Path

import pytest

from rack.boards.config import CONFIGS
from tests import golden
from tests.machine import needs_lab
from tests.processes import RACK
from tests.snapshots import Snapshots
from tests.tools.command_line import rack

pytestmark = [pytest.mark.thorough, needs_lab]

SNAPSHOTS = Snapshots(__file__)
PAGE = (CONFIGS / "cell" / "README.md").read_text().replace("\\\n", "")
BLOCKS = [
    [shlex.split(line, comments=True)[1:] for line in block.splitlines()]
    for block in re.findall(r"(?m)(?:^    rack .*\n)+", PAGE)
]
"""The words of the commands of each block, after `rack`."""
OWN_MEMORY = ("unshare", "--mount", "sh", "-c", 'mount -t tmpfs none /dev/shm; exec "$@"', "sh")
"""Runs a command as on a machine of its own: the racks of the page have their own names."""
ONE_MACHINE = ("unshare", "--net", "--pid", "--fork", "--kill-child", "--mount-proc")
MOST_S = 240.0


def test_the_page_of_networks_has_the_same_commands() -> None:
    page = (CONFIGS.parent / "boards" / "NETWORK.md").read_text()
    lines = re.findall(r"(?m)^rack (run cell.*)$", page)
    assert [shlex.split(line, comments=True) for line in lines] == BLOCKS[0]


def test_on_one_machine_in_lockstep_the_hand_over_is_the_same_everywhere(tmp_path: Path) -> None:
    commands, _ = BLOCKS
    # By the name of the files of each rack.
    racks = {words[1].replace("/", "-"): words for words in commands}
    script = ["ip link set lo up"]
    for name, words in racks.items():
        command = shlex.join([*RACK, *words, "--lockstep", "--out", name, "--json"])
        script.append(f"{command} >{name}.json 2>{name}.err &")
    command = "\n".join([*script, "wait"])
    subprocess.run(
        [*ONE_MACHINE, *OWN_MEMORY, "bash", "-c", command], cwd=tmp_path, timeout=MOST_S, check=True
    )
    said = {name: (tmp_path / f"{name}.err").read_text()[-1000:] for name in racks}
    texts = {name: (tmp_path / f"{name}.json").read_text() for name in racks}
    assert all(texts.values()), said
    found = {name: json.loads(text) for name, text in texts.items()}
    causes = {name: report["outcome"]["cause"] for name, report in found.items()}
    assert causes == dict.fromkeys(racks, "task done"), said
    if golden.machine()["libm"] == golden.read()["machine"]["libm"]:
        SNAPSHOTS.check("lockstep", {name: report["digest"] for name, report in found.items()})
    done = rack("analyze", *(tmp_path / name for name in found), "--json")
    across = json.loads(done.stdout)["across"]
    assert (done.returncode, len(across)) == (0, 4)
    measured = [one for one in across if one["count"]]
    assert "status" in {one["direction"] for one in measured}
    for response in measured:
        assert response["measured_ms"]["max"] == pytest.approx(response["bound_ms"])
        assert response["holds"]
