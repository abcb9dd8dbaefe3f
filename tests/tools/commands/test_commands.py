"""Tests the commands as a user runs them: answers, exit statuses, and nothing left behind."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from rack.backplane.segment import list_racks
from rack.boards import Rack
from rack.boards.config import RackConfig
from rack.tools.console.interrupt import list_descendants
from tests.processes import RACK, is_ticking, run_to_end, runs, wait_until
from tests.tools.command_line import BOUND_S, ROOT, rack, read_answer, read_refusal, started
from tests.warm import run_command


@contextmanager
def launched(small: Path, name: str, *arguments: object) -> Iterator[subprocess.Popen[str]]:
    """A real-time rack without an end, after its first cycles."""
    settings = ("--set=clock.mode=realtime", f"--set=name={name}")
    with started("run", small, *settings, *arguments) as process:
        wait_until(lambda: is_ticking(name) or process.poll() is not None, BOUND_S)
        yield process


@pytest.fixture
def running(small: Path, rack_name: str) -> Iterator[subprocess.Popen[str]]:
    with launched(small, rack_name, "--no-record") as process:
        yield process


WAITS = ("waiting: ", "still importing ")
"""How lines begin that say what a launch waits for."""
HEAVY = ("mujoco", "numba", "numpy", "pyarrow", "pydantic", "rerun", "typer")


def imported(*arguments: object) -> set[str]:
    """Run a command as a separate process, and return the heavy libraries that it imported."""
    command = [sys.executable, "-X", "importtime", *RACK[1:], *map(str, arguments)]
    done = run_to_end(command, BOUND_S, cwd=ROOT)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout
    names = {
        line.rpartition("|")[2].strip()
        for line in done.stderr.splitlines()
        if line.startswith("import time:")
    }
    assert "rack.tools.console.interrupt" in names
    return names & {*HEAVY}


@pytest.mark.slow
def test_a_command_starts_without_libraries_that_it_does_not_need(
    config: RackConfig, run: Path
) -> None:
    parser = {"typer", "pydantic"}
    assert imported("run", "--help") <= parser
    assert imported("list") <= parser
    with Rack(config):
        assert imported("status", config.name, "--json") <= {"numpy", *parser}
    rack("report", run)
    assert imported("report", run) <= parser


@pytest.mark.slow
def test_run_prints_one_json_document_and_nothing_else(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    words = ("run", small, "--seconds", 0.2, "--set", f"name={rack_name}", "--json")
    done = rack(*words, "--out", tmp_path / "run")
    report = json.loads(done.stdout)
    assert (done.returncode, done.stderr) == (0, ""), report["outcome"]
    assert (report["rack"], report["worked"], report["outcome"]["ticks"]) == (rack_name, True, 80)
    assert sorted(path.name for path in (tmp_path / "run").iterdir()) == [
        "checksums.xxh128",
        "code.json",
        "config.toml",
        "cycles.parquet",
        "events.jsonl",
        "published.json",
        "report.json",
        "report.md",
        "run.rrd",
        "signals",
    ]
    assert report["bytes_per_s"] == pytest.approx(report["bytes"] / 0.2)
    assert report["bytes"] > 0
    assert read_answer("report", tmp_path / "run") == report
    # The same document without a recording: what only a recording knows is null.
    bare = rack(*words, "--no-record")
    unrecorded = json.loads(bare.stdout)
    assert (bare.returncode, bare.stderr) == (0, "")
    assert unrecorded.keys() == report.keys()
    same = ("rack", "mode", "clock_ms", "worked", "outcome", "digest", "simulated_s", "missed")
    assert [unrecorded[key] for key in same] == [report[key] for key in same]
    nulls = [unrecorded[key] for key in ("folder", "misses", "recording")]
    assert nulls == [None, None, "none"]
    assert unrecorded["tasks"]["lower"].keys() <= report["tasks"]["lower"].keys()


def test_a_config_with_mistakes_is_refused_before_anything_starts(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    wrong = (f"name={rack_name}", "clock.wake=no", "board.lower.above=uper")
    settings = [word for setting in wrong for word in ("--set", setting)]
    done = rack("run", small, *settings, "--out", tmp_path / "run")
    assert (done.returncode, done.stdout) == (2, "")
    assert len(done.stderr.splitlines()) == 2
    assert not (tmp_path / "run").exists()
    assert rack_name not in list_racks()


def upper_of(small: Path, source: str) -> Path:
    """Let the upper level of the small rack be a class of a user's module."""
    (small.parent / "own_upper.py").write_text(source)
    text = small.read_text().replace('python_path = ["', f'python_path = ["{small.parent}", "')
    small.write_text(text.replace("two_levels:Upper", "own_upper:Upper"))
    return small


@pytest.mark.slow
@pytest.mark.parametrize("command", [("run", "--no-record"), ("check",)])
def test_a_module_that_ends_its_process_is_a_mistake_of_the_config(
    command: tuple[str, ...], small: Path, rack_name: str
) -> None:
    config = upper_of(small, "import os; os._exit(5)")
    words = (*RACK, *command, config, "--set", f"name={rack_name}")
    done = run_command(words, BOUND_S, cwd=small.parent, text=True)
    reason = "cannot import 'own_upper': ImportError: it ended the process: exit status 5"
    assert (done.returncode, done.stdout) == (2, "")
    # On a slow machine it also says what it waits for.
    said = [line for line in done.stderr.splitlines() if not line.startswith(WAITS)]
    assert said == [f'board.upper.executor = "own_upper:Upper": {reason}']


@pytest.mark.thorough
def test_a_module_that_loops_is_named_and_ended_by_a_signal(small: Path, rack_name: str) -> None:
    config = upper_of(small, "while True: pass")
    words = ("run", "--no-record", config, "--set", f"name={rack_name}")
    with started(*words, cwd=small.parent) as process:
        assert process.stderr is not None
        # On a slow machine other modules before it, and the crate.
        said = next(line for line in process.stderr if "own_upper" in line)
        assert said == "still importing 'own_upper'; it may take 60 s\n"
        family = list(list_descendants(process.pid))
        # The crate, and the child that imports.
        assert len(family) == 2
        process.send_signal(signal.SIGINT)
        assert process.wait(BOUND_S) == 128 + signal.SIGINT
    wait_until(lambda: not any(map(runs, family)))


@pytest.mark.slow
def test_a_running_rack_can_be_seen_and_stopped(
    running: subprocess.Popen[str], rack_name: str
) -> None:
    listed = {entry["rack"]: entry["state"] for entry in read_answer("list")}
    assert listed[rack_name] == "running"
    seen = read_answer("status", rack_name)
    assert {task["task"] for task in seen["tasks"]} == {"upper", "lower", "lower.planner"}
    assert seen["tick"] > 0
    assert rack_name in rack("status", rack_name).stdout
    assert rack("stop", rack_name).returncode == 0
    running.communicate(timeout=BOUND_S)
    wait_until(lambda: rack_name not in list_racks(), BOUND_S)


@pytest.mark.slow
def test_ctrl_c_ends_a_run_in_order(small: Path, rack_name: str, tmp_path: Path) -> None:
    with launched(small, rack_name, "--out", tmp_path / "run") as running:
        running.send_signal(signal.SIGINT)
        printed, said = running.communicate(timeout=BOUND_S)
    assert running.returncode == 128 + signal.SIGINT
    wait_until(lambda: rack_name not in list_racks(), BOUND_S)
    folder = tmp_path / "run"
    if "no time for the report" in said:
        # On a busy machine the time for an end in order does not suffice: the run is whole.
        assert rack("report", str(folder)).stdout
        return
    assert f"{rack_name}: STOPPED after " in printed
    report = json.loads((folder / "report.json").read_text())
    assert (report["outcome"]["cause"], report["recording"]) == ("stopped", "complete")


@pytest.mark.slow
def test_leftovers_of_a_killed_launcher_are_cleaned(
    running: subprocess.Popen[str], rack_name: str
) -> None:
    running.kill()
    running.wait(BOUND_S)
    seen = rack("status", rack_name)
    assert seen.stdout.startswith(f"rack {rack_name}: dead, ")
    assert "; its launcher is gone: 'rack clean' removes it" in seen.stdout.splitlines()[0]
    cleaned = read_answer("clean")
    assert rack_name not in cleaned["in_use"]
    assert rack_name not in list_racks()


def test_a_folder_that_holds_files_is_not_written_over(small: Path, tmp_path: Path) -> None:
    refusal = read_refusal(rack("run", small, "--seconds", 1, "--out", tmp_path))
    assert "not an empty folder" in refusal
