"""`rack reproduce` as a command: one section by real runs that are killed and continued."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
from pathlib import Path

import pytest

from rack.tools.lab.reproduction.experiments.experiment import RESULTS_FOLDER, load_result
from rack.tools.lab.reproduction.experiments.nasrem import DEADLINE
from tests.processes import RACK, wait_until
from tests.tools.command_line import BOUND_S, rack, read_refusal

pytestmark = [pytest.mark.thorough, pytest.mark.timeout(200)]
SECTION = "3"


@pytest.mark.alone
def test_a_killed_command_leaves_whole_results_and_can_be_continued(tmp_path: Path) -> None:
    killed = tmp_path / "paper"
    words = ("reproduce", "--out", str(killed), "--only", SECTION, "--share")
    process = subprocess.Popen([*RACK, *words], stdout=subprocess.DEVNULL, start_new_session=True)
    begun = killed / "runs" / "goto" / "events.jsonl"
    wait_until(lambda: begun.exists() or process.poll() is not None, BOUND_S)
    assert process.poll() is None, "it ended before its first run"
    os.killpg(process.pid, signal.SIGKILL)
    process.wait()
    assert not list((killed / RESULTS_FOLDER).iterdir())
    done = rack(*words, "--json")
    found = json.loads(done.stdout)
    (claim,) = next(one for one in found["sections"] if one["section"] == SECTION)["claims"]
    assert (done.returncode, done.stderr, claim["ruling"]) == (0, "", "holds")
    assert [path.name for path in (killed / RESULTS_FOLDER).iterdir()] == ["goto.json"]
    assert load_result(DEADLINE, killed) is not None
    page, text = ((killed / name).read_text() for name in ("index.html", "README.md"))
    targets = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert not [target for target in targets if not target.startswith(("#", "data:"))]
    assert all((killed / path).is_file() for path in re.findall(r"!\[[^\]]*\]\(([^)]+)\)", text))


def test_a_file_in_place_of_the_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    refusal = read_refusal(rack("reproduce", "--out", tmp_path / "file"))
    assert refusal == f"--out {tmp_path / 'file'}: exists, and is not a folder"
