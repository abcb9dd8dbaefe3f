"""Names of earlier versions in configs."""

from __future__ import annotations

import signal
import subprocess
import sys
from pathlib import Path

import pytest

from rack.boards import Rack
from rack.boards.config import CONFIGS, load, loads, wire
from rack.boards.config.schema import RackConfig
from rack.levels.references import MOVED, current, module_and_name
from tests.processes import BOUND_S, RACK

SYSTEMS = ("fig2", "nist-state-table", "rccl", "hic", "penn", "chimera", "cell/puma", "cell")


def as_saved_before(config: RackConfig) -> tuple[RackConfig, list[str]]:
    """Return a config as a run of an earlier version saved it, and the old names in it."""
    text, used = config.text(), []
    for old, new in MOVED.items():
        if (
            changed := text.replace(f'"{new}:', f'"{old}:')
            if ":" not in old
            else text.replace(new, old)
        ) != text:
            text, used = changed, [*used, old]
    return loads(text), used


def test_each_old_name_leads_to_what_is_there() -> None:
    for old in MOVED:
        module, name = module_and_name(old if ":" in old else f"{old}:")
        assert not name or hasattr(module, name), old


def test_names_that_only_begin_like_a_moved_one_stay() -> None:
    assert current("rack.levels.handle:Grip") == "rack.levels.handle:Grip"
    assert current("rack.levels.servo:ServoExecutor") == "rack.levels.servo:ServoExecutor"
    assert (
        current("rack.levels.hand.workstation:Workstation")
        == "rack.levels.systems.hand.workstation:Workstation"
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_a_config_saved_before_is_wired_as_today(name: str) -> None:
    config = load(CONFIGS / f"{name}.toml" if "/" in name else name)
    saved, used = as_saved_before(config)
    assert used
    assert wire(saved) == wire(config)


@pytest.mark.slow
def test_a_config_saved_before_runs_as_today(rack_name: str) -> None:
    config = load("rccl", [f"name={rack_name}", "clock.mode=lockstep"])
    saved, used = as_saved_before(config)
    assert {"rack.levels.servo:JointServo", "rack.levels.trajectory"} <= set(used)
    digests = []
    for each in (config, saved):
        with Rack(each) as rack:
            digests.append(rack.run(0.2).digest)
    assert digests[0] == digests[1]


def importing(folder: Path, source: str, *setup: str) -> subprocess.Popen[str]:
    """Return a process that imports a user's module of this source."""
    (folder / "theirs.py").write_text(source)
    lines = (
        "from rack.levels import references",
        *setup,
        "references.module_and_name('theirs:Level')",
    )
    return subprocess.Popen(
        [sys.executable, "-c", "\n".join(lines)],
        cwd=folder,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def test_a_module_that_ends_the_process_is_named(tmp_path: Path) -> None:
    process = importing(tmp_path, "import os\nos._exit(5)\n")
    assert process.communicate(timeout=BOUND_S) == (
        None,
        "'theirs' ended the process while it was imported\n",
    )
    assert process.returncode == 5


def test_a_module_that_takes_long_is_named_and_ended(tmp_path: Path) -> None:
    setup = "references.SLOW_S, references.IMPORT_S = 0.1, 0.2"
    process = importing(tmp_path, "while True:\n    pass\n", setup)
    said = process.communicate(timeout=BOUND_S)[1]
    assert said == "importing 'theirs', at most 0.2 s\n'theirs' was not imported within 0.2 s\n"
    assert process.returncode == -signal.SIGTERM


@pytest.mark.slow
def test_an_import_that_loops_is_interrupted_by_ctrl_c(tmp_path: Path, small: Path) -> None:
    (tmp_path / "looping.py").write_text("while True:\n    pass\n")
    text = small.read_text().replace("python_path = [", f'python_path = ["{tmp_path}", ')
    small.write_text(text.replace("two_levels:Upper", "looping:Upper"))
    process = subprocess.Popen([*RACK, "check", str(small)], stderr=subprocess.PIPE, text=True)
    assert process.stderr is not None
    assert process.stderr.readline() == "importing 'looping', at most 60 s\n"
    process.send_signal(signal.SIGINT)
    assert process.wait(BOUND_S) == 130
    process.stderr.close()
