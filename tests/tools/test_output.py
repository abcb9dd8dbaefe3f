"""Tests what every command prints into a pipe, into a closed pipe, and on a narrow terminal."""

from __future__ import annotations

import fcntl
import os
import pty
import re
import struct
import subprocess
import termios
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from rack.tools.cli import COMMANDS
from rack.tools.console.answer import PIPE_WIDTH
from tests.processes import RACK, run_to_end
from tests.tools.command_line import BOUND_S, ROOT, rack, read_answer, started
from tests.tools.held_racks import held_rack

NAMES = [name for commands in COMMANDS.values() for name in commands]
IDLE = (
    "list",
    "clean",
    "check nasrem",
    "check nasrem --verbose",
    "check fig3",
    "check condor --verbose",
    "check SMALL",
    "analyze RUN",
    "analyze RUN --verbose",
    "gantt fig3 --out FOLDER/chart",
    "export RUN --to mcap --out FOLDER/run.mcap",
    "schema",
    "schema board",
    "schema robot",
    "inject --help",
    "robot check k1607 --out FOLDER/arm",
    "new servo LAW",
    "lan certificates FOLDER/certificates --for one",
)
"""Command lines that need no running rack. LAW, RUN and so on stand for what a test made."""
LIVE = (
    "status NAME",
    "step NAME 2",
    "mailbox NAME",
    "mailbox NAME counter.status",
    "command NAME --list",
    "inject NAME watch mute for=1s",
    "inject NAME --list",
    "pause NAME",
    "estop NAME",
    "status NAME",
)
"""Command lines for a held rack, in this order."""
CUT_OFF = (
    "list",
    "check fig3",
    "check condor --verbose",
    "analyze RUN",
    "export RUN --to mcap --out FOLDER/run.mcap",
    "schema board",
    "inject --help",
    "report RUN",
    "check fig3 --json",
)
"""Command lines of which `make test` closes the pipe: one for each way to print, short and long."""
COLOURS = re.compile(r"\x1b\[[0-9;]*m")


@pytest.fixture
def words_of(
    small: Path, run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> dict[str, str]:
    """What the words of a command line stand for, relative to the folder of the test."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "run").symlink_to(run)
    return {"SMALL": small.name, "RUN": "run", "FOLDER": ".", "LAW": "my_law"}


def fill_in(line: str, words: dict[str, str]) -> list[str]:
    """Return the arguments of a command line."""
    return re.sub("|".join(words), lambda word: words[word[0]], line).split()


def find_wide_lines(text: str) -> list[str]:
    """Return the lines that are wider than a pipe permits. A word alone is not broken."""
    return [line for line in text.splitlines() if len(line) > PIPE_WIDTH and " " in line.strip()]


@pytest.mark.parametrize("name", NAMES)
def test_help_is_narrower_than_a_pipe_keeps_its_lines_and_shows_no_escapes(
    name: str, tmp_path: Path
) -> None:
    text = rack(name, "--help", folder=tmp_path).stdout
    assert find_wide_lines(text) == []
    assert "\\b" not in text
    _, _, examples = text.partition("Examples:\n")
    assert not examples or examples.lstrip().startswith("rack ")


@pytest.mark.slow
@pytest.mark.parametrize("line", IDLE)
def test_a_pipe_gets_no_wide_line(line: str, words_of: dict[str, str], tmp_path: Path) -> None:
    done = rack(*fill_in(line, words_of), folder=tmp_path)
    # On a busy machine a cycle of the run may have been too long.
    may_fail = line.startswith(("check fig3", "analyze"))
    assert done.returncode in ((0, 1) if may_fail else (0,)), done.stderr
    assert done.stdout
    assert find_wide_lines(done.stdout) == []
    assert "\x1b" not in done.stdout


def print_into_closed_pipe(arguments: list[str]) -> subprocess.CompletedProcess[str]:
    """Run a command whose reader closes the pipe after its first line, as `head -1` does."""
    reader, writer = os.pipe()
    with started(*arguments, stdin=None, stdout=writer, cwd=None) as process:
        os.close(writer)
        os.read(reader, 1)
        os.close(reader)
        _, errors = process.communicate(timeout=BOUND_S)
    return subprocess.CompletedProcess(arguments, process.returncode, "", errors)


@pytest.mark.slow
@pytest.mark.parametrize(
    "line",
    [
        *CUT_OFF,
        *(
            pytest.param(line, marks=pytest.mark.thorough)
            for line in (*IDLE, "analyze RUN --json")
            if line not in CUT_OFF
        ),
    ],
)
def test_a_reader_that_closes_the_pipe_causes_no_traceback(
    line: str, words_of: dict[str, str]
) -> None:
    done = print_into_closed_pipe(fill_in(line, words_of))
    # All may have been written before the pipe was closed.
    assert done.returncode in (0, 1)
    assert done.stderr == "" or "Traceback" not in done.stderr


def show_on_terminal(arguments: list[str], columns: int) -> str:
    """Return what a command prints on a terminal without colours."""
    screen, terminal = pty.openpty()
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", 24, columns, 0, 0))
    hidden = ("COLUMNS", "LINES")
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    environment |= {"NO_COLOR": "1", "TERM": "xterm"}
    with started(*arguments, stdin=None, stdout=terminal, env=environment) as process:
        os.close(terminal)
        printed = b""
        try:
            while block := os.read(screen, 1 << 16):
                printed += block
        except OSError:
            # The command has closed the terminal.
            pass
        assert "Traceback" not in process.communicate(timeout=BOUND_S)[1], arguments
    os.close(screen)
    return printed.decode().replace("\r\n", "\n")


@pytest.fixture(scope="module")
def held(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Name of a rack that is held: only a closed pipe ends a command that watches it."""
    name = f"test-output-{os.getpid()}"
    with held_rack(tmp_path_factory.mktemp("held"), name):
        yield name


@pytest.mark.slow
def test_a_pipe_gets_no_wide_line_about_a_running_rack(held: str) -> None:
    for line in LIVE:
        done = rack(*fill_in(line, {"NAME": held}))
        assert done.returncode == 0, (line, done.stderr)
        assert find_wide_lines(done.stdout) == [], line
        assert "\x1b" not in done.stdout


@pytest.mark.thorough
@pytest.mark.parametrize(
    "lines",
    [("status NAME", "step NAME 2", "command NAME --list", "top NAME"), LIVE],
    ids=["some", "all"],
)
def test_a_closed_pipe_causes_no_traceback_while_a_rack_runs(
    held: str, lines: Sequence[str]
) -> None:
    for line in lines:
        done = print_into_closed_pipe(fill_in(line, {"NAME": held}))
        assert done.returncode in (0, 1), (line, done.stderr)
        assert "Traceback" not in done.stderr, line


@pytest.mark.thorough
@pytest.mark.parametrize(
    "lines",
    [
        ("check nasrem --verbose", "check fig3", "status NAME"),
        ("schema timing", "inject --list", "analyze RUN --verbose"),
    ],
    ids=["some", "more"],
)
def test_a_terminal_of_40_columns_gets_a_narrower_layout_without_colours(
    lines: Sequence[str], run: Path, held: str
) -> None:
    for line in lines:
        shown = show_on_terminal(fill_in(line, {"RUN": str(run), "NAME": held}), 40)
        assert not re.findall(r"\x1b\[(?:3|4|9)[0-9]", shown), line
        if line.startswith("check"):
            wide = [each for each in shown.splitlines() if len(each) > 40]
            assert not wide, line
        assert COLOURS.sub("", shown).strip(), line


def test_output_without_unicode_shows_bars_and_no_traceback() -> None:
    environment = os.environ | {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0", "LC_ALL": "C"}
    done = run_to_end([*RACK, "check", "fig3"], BOUND_S, cwd=ROOT, env=environment)
    assert (done.returncode, done.stderr) == (1, "")
    assert "core 1  [################] 105.6%  level 67%, level.planner 39%" in done.stdout
    document = read_answer("check", "fig3", status=1)
    assert document["timing"]["loads"]["1"] > 1.0
