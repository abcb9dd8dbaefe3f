"""Looking at a rack or a run, or commanding it, imports nothing that its config names."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import pytest

import rack as api
from rack.backplane.segment import Segment, list_racks
from rack.boards.faults import KINDS
from rack.tools.cli import COMMANDS
from tests.boards.commanded_racks import COMMANDED, commands
from tests.processes import RACK, run_to_end, wait_until
from tests.tools.command_line import BOUND_S, rack, read_answer, read_refusal, started
from tests.tools.held_racks import running_rack
from tests.warm import run_command

MODULE = "spy_levels"
SPY = '''
"""Levels of somebody else, which note each program that imports them."""

import os
from pathlib import Path

with Path(__file__).with_suffix(".imported").open("a") as file:
    file.write(Path("/proc/self/cmdline").read_text().replace("\\0", " ") + "\\n")

from commanded_levels import Homing, Upper

from rack.backplane.watch.alarms import Alarm
from rack.boards.faults import KINDS, Kind, Parameter
from rack.boards.faults.bounds import DELIVERY, write_bound
from rack.boards.faults.message_steps import Drop

KINDS.add(
    Kind(
        "spy-drop",
        "writer",
        "a message is lost",
        detected_as=(Alarm.GAP,),
        bound=write_bound(1) + DELIVERY,
        step=Drop,
        parameters=(Parameter("probability", "1", "part that is lost", 1.0, 0.5, 1.0),),
    )
)
'''
RUNS_THEM = {
    "run": "it runs a config",
    "check": "it checks a config",
    "robot": "it checks a config",
    "schema": "it shows the keys of a config's levels",
    "prompt": "it runs a program of the caller's own rack",
    "rewind": "it runs the rack of a run again",
    "campaign": "it runs a config",
    "bench": "it runs configs",
    "reproduce": "it runs configs",
}
"""The commands that may import what a config names. Any other one is tested below."""


class Spied(NamedTuple):
    """A rack that runs in real time, one in lockstep, and a recorded run, all with levels that note
    who imports them."""

    rack: str
    lockstep: str
    run: Path
    marker: Path


ARGUMENTS: dict[str, Callable[[Spied], Sequence[Sequence[object]]]] = {
    "new": lambda spied: [("level", "fresh_level", "--out", spied.run.parent / "fresh")],
    "list": lambda spied: [()],
    "status": lambda spied: [(spied.rack,), (spied.rack, "--json")],
    "watch": lambda spied: [
        (
            *(spied.rack, "lower.status.count", "--when", "lower.status.count > 1"),
            *("--before", "10ms", "--after", "10ms", "--out", spied.run / "watched.csv"),
        )
    ],
    "mailbox": lambda spied: [(spied.rack,), (spied.rack, "lower.status")],
    "command": lambda spied: [
        (spied.rack, "--list"),
        (spied.rack, "upper", "hold"),
        (spied.rack, "upper", "resume"),
        (spied.rack, "lower", "modify", "twice", "on"),
    ],
    "set": lambda spied: [(spied.rack, "board.lower.params.by=2")],
    "inject": lambda spied: [
        ("--list",),
        (spied.rack, "lower", "spy-drop", "probability=0.5", "--cycles", "3"),
        (spied.rack, "--list"),
    ],
    "pause": lambda spied: [(spied.rack,)],
    "resume": lambda spied: [(spied.rack,)],
    "step": lambda spied: [(spied.lockstep,)],
    "estop": lambda spied: [(spied.rack,), (spied.rack, "--reset")],
    "clean": lambda spied: [()],
    "replay": lambda spied: [(spied.run, "--out", spied.run / "again.rrd")],
    "export": lambda spied: [(spied.run,)],
    "plot": lambda spied: [(spied.run, "lower.status.state")],
    "picture": lambda spied: [(spied.run, "--help")],
    "report": lambda spied: [(spied.run,), (spied.run, "--against", spied.run)],
    "analyze": lambda spied: [(spied.run,), (spied.run, "--response")],
    "gantt": lambda spied: [(spied.run,)],
    "lan": lambda spied: [("certificates", spied.run / "certs", "--for", "someone")],
}
"""Arguments with which each command is tried, on a rack that runs and on a run."""
AS_PROCESSES = {
    "bridge": lambda spied: (spied.rack, "foxglove"),
    "top": lambda spied: (spied.rack,),
    "record": lambda spied: (spied.rack, "--out", spied.run.parent / "recorded"),
}
"""Commands that last as long as the rack; `stop` ends it."""
BOARDS = ("upper", "lower")
HOLD = commands('level = "upper", what = "hold", tick = 300')


@pytest.fixture(scope="module")
def spied(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Spied]:
    folder = tmp_path_factory.mktemp("somebody")
    own = tmp_path_factory.mktemp("levels")
    (own / f"{MODULE}.py").write_text(SPY)
    path, run, marker = folder / "spied.toml", folder / "run", own / f"{MODULE}.imported"
    text = COMMANDED.replace("commanded_levels:Lower", f"{MODULE}:Homing")
    text = text.replace("commanded_levels:Upper", f"{MODULE}:Upper")
    path.write_text(text.replace("python_path = [", f'python_path = ["{own}", '))
    given = ("--share", *(f"--set=board.{board}.budget.process_ms=0.1" for board in BOARDS))
    fault = 'fault=[{ kind = "spy-drop", board = "lower", tick = 200, cycles = 2 }]'
    short = ("--lockstep", "--seconds", "1", "--out", str(run), "--json")
    recorded = [*RACK, "run", str(path), *given, *short, f"--set={fault}", f"--set={HOLD}"]
    done = run_command(recorded, BOUND_S, text=True)
    assert done.returncode == 0, done.stderr
    # The command, its crate and others.
    assert marker.read_text()
    # In lockstep a rack writes faster than `rack watch` may read.
    name = f"test-spied-{os.getpid()}"
    modes = {name: "--set=clock.mode=realtime", f"{name}-steps": "--lockstep"}
    with ExitStack() as stack:
        for one, mode in modes.items():
            stack.enter_context(running_rack(path, one, *given, mode))
        marker.unlink()
        yield Spied(*modes, run, marker)


@pytest.fixture
def guarded(spied: Spied, monkeypatch: pytest.MonkeyPatch) -> Iterator[Spied]:
    """The levels, where an import would find them even without the config's path."""
    monkeypatch.syspath_prepend(str(spied.marker.parent))
    monkeypatch.setattr(KINDS, "names", dict(KINDS.names))
    monkeypatch.setattr(KINDS, "_by_number", dict(KINDS._by_number))
    before = list(sys.path)
    yield spied
    assert not spied.marker.exists(), spied.marker.read_text()
    assert MODULE not in sys.modules
    assert sys.path == before


def test_every_command_is_tried_or_said_to_run_what_a_config_names() -> None:
    assert {name for found in COMMANDS.values() for name in found} == {
        *RUNS_THEM,
        *ARGUMENTS,
        *AS_PROCESSES,
        "stop",
    }


@pytest.mark.slow
@pytest.mark.parametrize("command", ARGUMENTS)
def test_a_command_imports_nothing_that_a_config_names(command: str, guarded: Spied) -> None:
    for arguments in ARGUMENTS[command](guarded):
        done = rack(command, *arguments)
        assert done.returncode == 0, (arguments, done.stdout, done.stderr)


@pytest.mark.slow
def test_a_program_that_attaches_imports_nothing_that_a_config_names(guarded: Spied) -> None:
    with api.attach(guarded.rack) as live:
        assert live.command("lower", "hold").worked
        assert live.command("lower", "resume").worked
        assert live.set("board.lower.params.by", 3).worked
        live.inject("lower", "spy-drop", cycles=2)
        assert live.wait_for("begins", BOUND_S).text.startswith("spy-drop (probability 1")
        assert live.status().rack == guarded.rack
    run = api.open_run(guarded.run)
    assert run.report["faults"][0]["kind"] == "spy-drop"


@pytest.mark.slow
def test_a_report_made_again_knows_kinds_that_levels_add(guarded: Spied) -> None:
    (guarded.run / "report.json").unlink()
    (fault,) = read_answer("report", guarded.run)["faults"]
    assert (fault["kind"], fault["seen"], fault["found_as"]) == ("spy-drop", "detected", "gap")
    published = guarded.run / "published.json"
    text = published.read_text()
    KINDS._by_number.pop(KINDS.names.pop("spy-drop").number)
    try:
        for place, said in (
            (lambda: published.write_text("{}"), "published.json: damaged"),
            (published.unlink, "unknown kind 'spy-drop'"),
        ):
            place()
            (guarded.run / "report.json").unlink(missing_ok=True)
            assert said in read_refusal(rack("report", guarded.run))
    finally:
        published.write_text(text)


@pytest.mark.slow
@pytest.mark.skipif(os.getuid() != 0, reason="only root attaches to racks of other users")
def test_a_prompt_is_refused_on_a_rack_of_another_user(guarded: Spied) -> None:
    segment = Segment.attach(guarded.rack)
    try:
        os.fchown(segment.fd, 4711, -1)
        done = rack("prompt", guarded.rack)
    finally:
        os.fchown(segment.fd, os.getuid(), -1)
        segment.close()
    assert "belongs to user 4711" in read_refusal(done, status=1)


@pytest.mark.slow
def test_commands_that_last_as_long_as_the_rack_import_nothing(guarded: Spied) -> None:
    environment = {**os.environ, "PYTHONPATH": str(guarded.marker.parent), "FOXGLOVE_PORT": "0"}
    with ExitStack() as stack:
        processes = {
            command: stack.enter_context(
                started(command, *arguments(guarded), env=environment, stderr=subprocess.STDOUT)
            )
            for command, arguments in AS_PROCESSES.items()
        }
        spool = guarded.run.parent / "recorded" / "published.json"
        wait_until(spool.exists)
        maps = [Path(f"/proc/{process.pid}/maps") for process in processes.values()]
        # All have mapped the rack's segment.
        wait_until(lambda: all(guarded.rack in path.read_text() for path in maps))
        stopped = rack("stop", guarded.rack, "--wait", BOUND_S)
        assert stopped.returncode == 0, stopped.stderr
        for command, process in processes.items():
            printed, _ = process.communicate(timeout=BOUND_S)
            assert process.returncode == 0, (command, printed)
    assert guarded.rack not in list_racks()


@pytest.mark.thorough
def test_a_file_in_the_current_folder_is_no_module_of_a_crate_or_a_recorder(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    (tmp_path / "numpy.py").write_text(f"open({str(tmp_path / 'imported')!r}, 'w')")
    safe = [sys.executable, "-P", *RACK[1:]]
    given = ["--set", f"name={rack_name}", "--seconds", "0.1", "--out", tmp_path / "run"]
    done = run_to_end([*safe, "run", small, *given], BOUND_S, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert not (tmp_path / "imported").exists()
