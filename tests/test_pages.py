"""The pages of the layers are short enough to be read, and their commands run: here those that need
a recorded run or a running rack, in test_readme.py all others."""

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
from tests.processes import RACK, wait_until
from tests.test_readme import BLOCK, CODE, ELSEWHERE, PAGES, SHELL
from tests.tools.command_line import BOUND_S, ROOT, rack

pytestmark = pytest.mark.thorough

MOST_WORDS, MOST_FIGURES = 900, 15
MOST_WORDS_OF_DETAILS = 1500
LAYERS = [page for page in PAGES[1:] if page.name in ("README.md", "ARCHITECTURE.md")]
UNITS = (
    r"(?:%|[mun]?s|min|h|minutes?|hours?|seconds?|[kMG]?Hz|[mck]?m|kg|J|N|W|m?rad(?:/s)?"
    r"|degrees|[kMG]?B|kB/s)"
)
NUMBER = r"\d[\d,]*(?:\.\d+)?"
FIGURE = re.compile(rf"{NUMBER}(?:(?: to |, | and |-){NUMBER})* ?{UNITS}(?![\w/])")
"""A figure is a number with a unit of measurement, measured or quoted, in prose or in a table.
Numbers in code, of equations and of sections are none, nor are counts of things."""

OWN_NAME = f"pages-{os.getpid()}"
MODEL = ROOT / "configs" / "examples" / "own-arm" / "desk-arm.xml"
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
    "rack run nasrem --faults kill-each-board": "golden.py",
    "rack run rccl --faults kill-each-board": "golden.py",
    "rack run nist-state-table --lockstep --step": "tools/test_state_table_run.py",
    "rack run brown --lockstep": "test_brown_network.py",
    "rack run cell/puma --share": "test_cell_page.py",
    "rack run cell/k1607 --share": "test_cell_page.py",
    "rack run cell --share": "test_cell_page.py",
    "rack replay runs/<puma> runs/<k1607>": "tools/viewer/test_merged.py",
    "rack prompt chimera": "tools/monitor/test_host_side.py",
    "rack estop 10.0.0.1/cell": "tools/network/test_estop.py",
    "rack estop 10.0.0.1/cell --ready": "tools/network/test_estop.py",
    "rack campaign nasrem --injections 20 --seed 1": "tools/commands/test_campaign.py",
    "rack reproduce --only 5": "tools/lab/reproduction/test_reproduce.py",
    "rack bench machine": "tools/lab/benches/test_machine.py",
    "rack bench cycle": "tools/lab/benches/test_cycle.py",
    "rack bench lockstep": "tools/lab/benches/test_lockstep.py",
    "rack bench launch": "tools/lab/benches/test_launch.py",
}
"""Commands that take minutes, a network or a screen, each with the test that runs it."""


def lines_of(page: Path) -> list[str]:
    """Return the commands of a page that test_readme.py does not run, without their remarks."""
    blocks = SHELL.findall(page.read_text())
    lines = [line.partition("#")[0].strip() for block in blocks for line in block.splitlines()]
    return [line for line in lines if line.startswith("rack ") and ELSEWHERE.search(line)]


@pytest.mark.parametrize("page", LAYERS, ids=lambda page: f"{page.parent.name}/{page.name}")
def test_the_page_of_a_layer_can_be_read_to_its_end(page: Path) -> None:
    text = page.read_text()
    figures = FIGURE.findall(CODE.sub("", text))
    counted = [number for figure in figures for number in re.findall(NUMBER, figure)]
    assert len(text.split()) <= MOST_WORDS
    assert len(counted) <= MOST_FIGURES, figures


def test_every_other_page_has_one_subject_but_the_list_of_measured_figures() -> None:
    words = {page.name: len(page.read_text().split()) for page in PAGES}
    long = {name for name, count in words.items() if count > MOST_WORDS_OF_DETAILS}
    assert long <= {"MEASURED.md"}


def kind_of(line: str) -> str:
    """Return the name of the test that runs a command of the pages."""
    if line in OTHER_TESTS:
        return "other"
    if RUNNING.match(line):
        return "running"
    return "recorded" if RECORDED.search(line) else "new"


def of_kind(kind: str) -> list[str]:
    """Return the commands of all pages that one test runs, each once."""
    lines = dict.fromkeys(line for page in PAGES for line in lines_of(page))
    return [line for line in lines if kind_of(line) == kind]


def parsed(line: str) -> subprocess.CompletedProcess[str]:
    """Let `rack` read the words and options of a command without running it."""
    return rack(*shlex.split(line)[1:], "--help")


@pytest.mark.slow
@pytest.mark.parametrize("line", OTHER_TESTS)
def test_a_command_of_a_test_elsewhere_is_on_a_page_and_understood(line: str) -> None:
    assert line in of_kind("other")
    program = (ROOT / "tests" / OTHER_TESTS[line]).read_text()
    assert re.search(rf"\b{line.split()[1]}\b|\b{line.split()[2]}\b", program)
    assert parsed(line).returncode == 0
    assert parsed(f"{line} --no-such-option").returncode == 2


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


def on_own_runs(line: str) -> list[str]:
    """Return the words of a command on a recorded run, for the runs of the fixture."""
    for name, own in NAMES.items():
        line = line.replace(name, own)
    words = shlex.split(line)[1:]
    # Not opened: written to a file.
    return [*words, "--out", "shown.rrd"] if words[0] == "replay" else words


@pytest.mark.slow
@pytest.mark.parametrize("line", of_kind("recorded"))
def test_a_command_on_a_recorded_run_works(
    line: str, runs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("whole", "branch"):
        shutil.copytree(runs / name, tmp_path / name)
    monkeypatch.setattr(sys, "stdin", StringIO("goto 6\nshow primitive.status\n"))
    done = rack(*on_own_runs(line), folder=tmp_path)
    assert done.returncode == int("report" in line and "--against" in line), done.stderr
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


@pytest.mark.slow
@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if any(kind_of(line) == "running" for line in lines_of(page))],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_the_commands_on_a_running_rack_work_in_their_order(page: Path, tmp_path: Path) -> None:
    lines = [line for line in lines_of(page) if kind_of(line) == "running"]
    lines.sort(key=lambda line: line.startswith("rack stop"))
    watching = []
    with running_rack(tmp_path):
        for line in lines:
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


@pytest.mark.slow
def test_an_arm_is_made_of_a_model_and_moves(tmp_path: Path) -> None:
    lines = [line for line in of_kind("new") if re.search(r"robot new|run arm", line)]
    assert [line.split()[1] for line in lines] == ["robot", "run"]
    for line in lines:
        words = line.replace("<arm.urdf>", str(MODEL)).split()[1:]
        short = ["--seconds", "1", "--no-record", "--share"] if words[0] == "run" else []
        done = rack(*words, *short, folder=tmp_path)
        assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_a_config_of_a_page_runs_beside_its_class(tmp_path: Path) -> None:
    blocks = {name: block for page in PAGES for name, block in BLOCK.findall(page.read_text())}
    configs = [name for name in blocks if name.endswith(".toml")]
    lines = [line for line in of_kind("new") if ".toml" in line]
    assert sorted(configs) == sorted(line.split()[2] for line in lines)
    for name, block in blocks.items():
        (tmp_path / name).write_text(block)
    for line in lines:
        own = ("--set", f"name={OWN_NAME}", "--share", "--no-record")
        done = rack(*line.split()[1:], *own, "--seconds", "2", folder=tmp_path)
        assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_certificates_are_made_as_the_page_says(tmp_path: Path) -> None:
    (line,) = [line for line in of_kind("new") if line.startswith("rack lan")]
    done = rack(*line.split()[1:], folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert {"cell", "cell-puma", "operator"} <= {path.stem for path in tmp_path.rglob("*")}


def test_every_command_of_the_pages_has_a_test() -> None:
    known = re.compile(r"rack (robot new|run arm|lan|run \S+\.toml)")
    assert not [line for line in of_kind("new") if not known.match(line)]
    assert all(of_kind(kind) for kind in ("recorded", "running", "new", "other"))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "printed"),
    [
        ("message", "12.5 (6,)\n"),
        ("signal", "time over\n(400, 6) rad\n"),
        ("moment", "(6,)\n[0.     0.0025 0.005 ]\n"),
    ],
)
def test_a_program_of_a_page_prints_what_it_says(name: str, printed: str, tmp_path: Path) -> None:
    (block,) = {
        block for page in PAGES for shown, block in BLOCK.findall(page.read_text()) if shown == name
    }
    # A rack of the same name may be at work on this machine.
    own = block.replace("lockstep=True", f'lockstep=True, settings={{"name": "{OWN_NAME}"}}')
    (tmp_path / "program.py").write_text(own)
    done = subprocess.run(
        [sys.executable, "program.py"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=BOUND_S,
        check=False,
    )
    assert (done.returncode, done.stdout) == (0, printed), done.stderr


@pytest.mark.slow
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


def test_every_measured_figure_has_a_date_a_commit_and_a_command() -> None:
    text = (ROOT / "tools" / "MEASURED.md").read_text()
    rows = re.findall(r"^\| (?!bench \||figure \||-)(.+) \|$", text, re.MULTILINE)
    cells = [re.split(r"\s*\|\s*", row) for row in rows if not row.startswith("---")]
    assert cells
    assert not [row for row in cells if len(row) not in (4, 6) or not row[0] or not row[1]]
    assert not [row for row in cells if not re.fullmatch(r"\d{4}-\d\d-\d\d", row[-2])]
    assert not [row for row in cells if not re.fullmatch(r"[0-9a-f]{8}", row[-1])]
