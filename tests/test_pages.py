"""The commands and programs of the README and of the reference pages work, each alone.

A command that needs a recorded run gets a run of this file, one that needs a running rack gets a
rack in lockstep, and a command of several pages runs once. Guides: test_guides.py.
"""

from __future__ import annotations

import json
import os
import re
import select
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from io import StringIO
from pathlib import Path

import pytest

from rack.backplane.segment import Segment, list_racks
from rack.backplane.words import System
from tests.pages import BLOCK, README, REFERENCES, ROOT, SHELL
from tests.processes import RACK, run_to_end, wait_until
from tests.tools.command_line import BOUND_S, rack

pytestmark = pytest.mark.thorough

OWN_NAME = f"pages-{os.getpid()}"
OWN = ("--set", f"name={OWN_NAME}", "--set", "supervision.max_missed_fraction=1", "--share")
"""A rack of the same name may be at work on this machine, which may be too busy to be in time."""
COMMANDED = f"""
format = 2
name = "{OWN_NAME}"
extends = ["nasrem"]

[[command]]
level = "task"
what = "hold"
at = 3.0

[[command]]
level = "task"
what = "resume"
at = 4.0
"""
"""nasrem, with commands of an operator whose responses can be measured."""
RECORDED = re.compile(r"\b(RUN2?|OTHER)\b|runs/<(run|other|branch)>")
"""Commands on a recorded run. These names stand for the runs of the fixture `runs`:"""
NAMES = {
    "RUN@12.5": "whole@6 --seconds 6.2 --no-record --share",
    "--out RUN": f"--out new --seconds 1 --set name={OWN_NAME} --share",
    "--at 11": "--at 3",
    "runs/<run>": "whole",
    "runs/<other>": "branch",
    "runs/<branch>": "branch",
    "RUN2": "branch",
    "RUN": "whole",
    "OTHER": "branch",
}
RUNNING = re.compile(
    r"rack (status|top|watch|mailbox|stop|pause|resume|set|inject|estop|command) (nasrem|RACK)\b"
    r"|rack record --save nasrem"
)
"""Commands on a running rack."""
SPOOLED_BYTES = 100_000
"""Less than the recording of one second of nasrem."""
WATCHING = ("top", "watch")
"""Commands that end with the rack, at the latest."""
REPLACED = {
    "RACK SIGNAL...": "nasrem servo.status.torque",
    "> -2.5": "> -9",
    "nasrem": OWN_NAME,
}
"""What stands in a command for a test: a condition that holds soon, a rack that is ours."""
OTHER_TESTS = {
    "rack run nasrem --view": "tools/commands/test_record.py",
    "rack record nasrem --view": "tools/commands/test_record.py",
    "rack run rccl --faults kill-each-board": "golden.py",
    "rack run nist-state-table --lockstep --step": "tools/test_state_table_run.py",
    "rack run brown --lockstep": "test_brown_network.py",
    "rack run brown --lockstep --seconds 2": "test_brown_network.py",
    "rack run cell/puma --share": "test_cell_page.py",
    "rack run cell/k1607 --share": "test_cell_page.py",
    "rack run cell --share": "test_cell_page.py",
    "rack replay runs/<puma> runs/<k1607>": "tools/viewer/test_merged.py",
    "rack analyze runs/<brown> runs/<brown-servo>": "test_brown_network.py",
    "rack prompt chimera": "tools/monitor/test_host_side.py",
    "rack command chimera trajectory schedule earliest-deadline-first": "test_chimera.py",
    "rack estop 10.0.0.1/cell": "tools/network/test_estop.py",
    "rack estop 10.0.0.1/cell --ready": "tools/network/test_estop.py",
    "rack campaign nasrem --injections 20 --seed 1": "tools/commands/test_campaign.py",
    "rack reproduce --only 5": "tools/lab/reproduction/test_reproduce.py",
    "rack bench machine": "tools/lab/benches/test_machine.py",
    "rack bench cycle": "tools/lab/benches/test_cycle.py",
    "rack bench lockstep": "tools/lab/benches/test_lockstep.py",
    "rack bench launch": "tools/lab/benches/test_launch.py",
    "rack robot new <arm.urdf> --name arm": "tools/robot/test_new.py",
    "rack run arm --lockstep": "test_guides.py",
    "rack run metered.toml --lockstep --seconds 8": "test_examples.py",
}
"""Commands that take minutes, a network or a screen, or are those of a guide or an example, each
with the test that runs it."""


LINES = {
    line.strip(): int("exit status 1" in remark)
    for page in REFERENCES
    for block in SHELL.findall(page.read_text())
    for line, _, remark in (line.partition("#") for line in block.splitlines())
    if line.startswith("rack ")
}
"""Commands of the pages without their remarks, with the exit status that these have."""


def kind_of(line: str) -> str:
    """Return the name of the test that runs a command of the pages."""
    if line in OTHER_TESTS:
        return "other"
    if RUNNING.match(line):
        return "running"
    return "recorded" if RECORDED.search(line) else "alone"


def of_kind(kind: str) -> list[str]:
    """Return the commands of all pages that one test runs, each once."""
    return [line for line in LINES if kind_of(line) == kind]


def words_of(line: str) -> list[str]:
    """Return the words of a command for a test; of an option that is given twice the last one
    counts."""
    words = shlex.split(line)[1:]
    if words == ["bench", "mailbox"]:
        return [*words, "--rounds", "20"]
    if words[0] != "run":
        return words
    # What the racks do is asserted by test_golden.py.
    return [*words, *OWN, "--no-record", "--seconds", "2" if "--lockstep" in words else "1"]


@pytest.mark.usefixtures("without_templates")
@pytest.mark.parametrize("line", of_kind("alone"))
def test_a_command_works(line: str, tmp_path: Path) -> None:
    for page in REFERENCES:
        for name, block in BLOCK.findall(page.read_text()):
            if name in line:
                (tmp_path / name).write_text(block)
    done = rack(*words_of(line), folder=tmp_path)
    assert done.returncode == LINES[line], done.stderr
    assert done.stdout


@pytest.mark.parametrize("line", OTHER_TESTS)
def test_a_command_of_a_test_elsewhere_is_on_a_page_and_understood(line: str) -> None:
    assert line in of_kind("other")
    program = (ROOT / "tests" / OTHER_TESTS[line]).read_text()
    assert re.search(rf"\b{line.split()[1]}\b|\b{line.split()[2]}\b", program)
    words = shlex.split(line)[1:]
    assert rack(*words, "--help").returncode == 0
    assert rack(*words, "--no-such-option", "--help").returncode == 2


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of two recorded runs: "whole", and "branch", which continues it from 6 s on."""
    folder = tmp_path_factory.mktemp("runs")
    # Under its own name: commands run it again, and so may tests of other files theirs.
    (folder / "own.toml").write_text(COMMANDED)
    whole = ("own.toml", "--lockstep", "--out", "whole")
    branch = ("--from", "whole@6", "--set", "board.servo.params.bandwidth=80", "--out", "branch")
    for words in (whole, branch):
        done = rack("run", *words, "--seconds", "7", "--share", folder=folder)
        assert done.returncode == 0, done.stderr
    return folder


@pytest.mark.parametrize("line", of_kind("recorded"))
def test_a_command_on_a_recorded_run_works(
    line: str, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("whole", "branch"):
        shutil.copytree(runs / name, tmp_path / name)
    monkeypatch.setattr(sys, "stdin", StringIO("goto 6\nshow primitive.status\n"))
    own = line
    for name, of_test in NAMES.items():
        own = own.replace(name, of_test)
    # A replay is not opened: it is written to a file.
    shown = ("--out", "shown.rrd") if own.startswith("rack replay") else ()
    done = rack(*shlex.split(own)[1:], *shown, folder=tmp_path)
    # What `analyze` finds depends on the speed of this machine.
    statuses = (0, 1) if "analyze" in line else (int("report" in line and "--against" in line),)
    assert done.returncode in statuses, done.stderr
    assert done.stdout or (tmp_path / "shown.rrd").is_file()


@contextmanager
def running_rack(folder: Path) -> Iterator[None]:
    """Run nasrem in lockstep, recorded, and held after its first messages."""
    words = ("--lockstep", "--step", "--share", "--set", f"name={OWN_NAME}", "--out", "run")
    with subprocess.Popen(
        [*RACK, "run", "nasrem", *words], cwd=folder, stdout=subprocess.DEVNULL
    ) as process:
        try:
            wait_until(lambda: OWN_NAME in list_racks(), BOUND_S)
            segment = Segment.attach(OWN_NAME)
            wait_until(lambda: segment.words[System.HELD], BOUND_S)
            segment.close()
            assert rack("step", OWN_NAME, "--ticks", "400").returncode == 0
            # Before the recorder has written rows there is nothing to save.
            spool = folder / "run" / "recorder.spool"
            wait_until(lambda: spool.is_file() and spool.stat().st_size > SPOOLED_BYTES, BOUND_S)
            yield
            rack("stop", OWN_NAME)
            process.wait(BOUND_S)
        finally:
            process.kill()
    rack("clean")


def start_watching(words: list[str], folder: Path) -> subprocess.Popen[str]:
    """Start a command that watches the rack, and step the rack until the command has printed."""
    process = subprocess.Popen([*RACK, *words], cwd=folder, stdout=subprocess.PIPE, text=True)

    def has_printed() -> bool:
        assert rack("step", OWN_NAME, "--ticks", "16").returncode == 0
        return bool(select.select([process.stdout], [], [], 0)[0])

    wait_until(has_printed, BOUND_S)
    return process


def test_the_commands_on_a_running_rack_work_in_their_order(tmp_path: Path) -> None:
    watching = []
    with running_rack(tmp_path):
        # In the order of the pages; those that end the rack last.
        for line in sorted(of_kind("running"), key=lambda line: line.startswith("rack stop")):
            for shown, own in REPLACED.items():
                line = line.replace(shown, own)
            words = shlex.split(line)[1:]
            if words[0] in WATCHING:
                watching.append(start_watching(words, tmp_path))
                continue
            # The machine may be too busy to write a report in the command's 10 s.
            words += ["--wait", str(BOUND_S)] if words[0] == "stop" else []
            done = rack(*words, folder=tmp_path)
            assert done.returncode == 0, f"{line}: {done.stderr}"
            assert done.stdout
    for process in watching:
        printed, _ = process.communicate(timeout=BOUND_S)
        assert printed
        assert process.returncode == 0


@pytest.mark.parametrize("kind", ["alone", "other", "recorded", "running"])
def test_the_pages_have_commands_of_every_kind(kind: str) -> None:
    assert of_kind(kind)


def run_program(program: str, folder: Path) -> str:
    """Run a program of a page under a rack's name of its own; return what it printed."""
    own = program.replace('["clock', f'["name={OWN_NAME}", "clock')
    own = own.replace(
        "lockstep=True, out", f'lockstep=True, settings={{"name": "{OWN_NAME}"}}, out'
    )
    own = own.replace('{"seed"', f'{{"name": "{OWN_NAME}", "seed"')
    own = own.replace('attach("nasrem")', f'attach("{OWN_NAME}")')
    (folder / "program.py").write_text(own)
    done = run_to_end([sys.executable, "program.py"], BOUND_S, cwd=folder)
    assert done.returncode == 0, done.stderr
    return done.stdout


def find_program(start: str) -> str:
    """Return the program of the pages that starts with a pattern."""
    text = "\n".join(page.read_text() for page in REFERENCES)
    (found,) = re.findall(rf"```python\n({start}.*?)```", text, re.DOTALL)
    return str(found)


@pytest.mark.parametrize(
    ("name", "printed"), [("message", "12.5 (6,)\n"), ("signal", "time over\n(400, 6) rad\n")]
)
def test_a_program_of_a_page_prints_what_it_says(name: str, printed: str, tmp_path: Path) -> None:
    (block,) = {
        block
        for page in REFERENCES
        for shown, block in BLOCK.findall(page.read_text())
        if shown == name
    }
    assert run_program(block, tmp_path) == printed


def test_the_program_that_launches_boards_works(tmp_path: Path) -> None:
    program = find_program(r"from rack\.boards").replace("seconds=10", "seconds=1")
    assert run_program(program, tmp_path).startswith("time over 400 ")


def test_the_program_of_the_readme_plots_a_killed_board(tmp_path: Path) -> None:
    (program,) = re.findall(r"```python\n(import rack\n.*?)```", README.read_text(), re.DOTALL)
    assert len(program.splitlines()) <= 15
    printed = run_program(program, tmp_path).splitlines()
    assert len(printed) == 2
    assert printed[0].startswith("'primitive' rejoined after ")
    assert printed[1] == "time over"
    assert (tmp_path / "velocity.png").read_bytes().startswith(b"\x89PNG")


def test_a_run_reads_back_as_the_page_has_it(runs: Path, tmp_path: Path) -> None:
    shutil.copytree(runs / "whole", tmp_path / "run")
    program = find_program("from pathlib").replace("runs/nasrem-20250101-120000", "run")
    program += "\nprint(ticks.shape, measured.shape, error.values.shape[1], len(lateness) > 0)"
    assert run_program(program, tmp_path) == "(2800,) (2800, 6) 6 True\n"


def test_the_prompt_of_rewind_answers_as_its_page_shows(
    runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(runs / "whole", tmp_path / "whole")
    page = (ROOT / "tools" / "REWIND.md").read_text()
    lines = re.findall(r"(?m)^[\d.]+ s> (.*?)(?:   .*)?$", page)
    assert {line.split()[0] for line in lines} == {"goto", "show", "step", "events", "branch"}
    # The run of this file is shorter than the page's.
    asked = "\n".join(lines).replace("goto 12.5", "goto 6")
    monkeypatch.setattr(sys, "stdin", StringIO(asked))
    done = rack("rewind", "whole", "--json", folder=tmp_path)
    assert done.returncode == 0, done.stdout
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(answers) == len(lines)
    assert not [answer for answer in answers if "error" in answer]
    assert (tmp_path / "slower" / "report.json").is_file()


def test_certificates_are_made_as_the_page_says(tmp_path: Path) -> None:
    (line,) = [line for line in LINES if line.startswith("rack lan")]
    done = rack(*words_of(line), folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert {"cell", "cell-puma", "operator"} <= {path.stem for path in tmp_path.rglob("*")}
