"""Tests the command line before any command: unusable arguments and paths, shell completion."""

from __future__ import annotations

import json
import os
import shlex
import sys
import tomllib
from collections.abc import Sequence
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from rack.tools.cli import COMMANDS
from rack.tools.commands.export import EXPORTERS
from tests.processes import RACK, run_to_end
from tests.tools.command_line import BOUND_S, ROOT, rack, read_refusal
from tests.warm import run_command

LONG = "a" * 5000
RUN_FIG2 = ("run", "fig2", "--lockstep", "--no-record")
NAMES = [name for found in COMMANDS.values() for name in found]


def run_process(line: Sequence[str | bytes], **environment: str) -> CompletedProcess[str]:
    """Run a command as a process."""
    return run_to_end(line, BOUND_S, cwd=ROOT, env=os.environ | environment)


@pytest.mark.parametrize(
    "arguments", [("check", LONG), ("run", "fig2", "--set", f"clock.speed={LONG}"), (LONG,)]
)
def test_an_argument_without_end_is_refused_in_one_line(arguments: tuple[str, ...]) -> None:
    refusal = read_refusal(rack(*arguments))
    assert refusal.startswith("argument ")
    assert refusal.endswith(" characters; must be at most 4096")
    assert len(refusal) < 200


@pytest.mark.parametrize(
    "arguments", [("report",), ("analyze",), ("replay",), ("gantt",), ("run", "fig2", "--out")]
)
def test_a_name_that_no_file_can_have_is_refused_in_one_line(arguments: tuple[str, ...]) -> None:
    assert "aaaaaaaa" in read_refusal(rack(*arguments, "a" * 300))


@pytest.mark.parametrize(
    ("words", "option"),
    [
        *((RUN_FIG2, f"--seconds={seconds}") for seconds in ("inf", "nan", "1e300", "-1")),
        *((("campaign", "fig2"), f"--faultless={seconds}") for seconds in ("nan", "inf", "-1")),
        (("campaign", "fig2"), "--seconds=inf"),
    ],
)
def test_an_infinite_or_negative_duration_is_refused(words: Sequence[str], option: str) -> None:
    done = rack(*words, option)
    assert (done.returncode, done.stdout) == (2, "")
    assert f"Invalid value for '{option.partition('=')[0]}'" in done.stderr


@pytest.mark.parametrize("command", NAMES)
def test_a_usage_error_of_any_command_is_a_document_under_json(command: str) -> None:
    done = rack(command, "--bogus", "--json")
    assert done.returncode == 2
    lines = json.loads(done.stdout)["error"]
    assert lines == done.stderr.splitlines()
    assert lines[-1].startswith("Error: No such option: --")
    assert rack(command, "--bogus").stdout == ""


def outputs(small: Path, rack_name: str) -> list[tuple[str, ...]]:
    """Return command lines that print, one for each way of printing."""
    run = ("run", str(small), "--set", f"name={rack_name}", "--seconds", "0.1", "--no-record")
    return [("list",), ("check", "fig2", "--json"), ("status", rack_name, "--json"), run]


def printed_to(stdout: int, arguments: tuple[str, ...], unbuffered: str) -> CompletedProcess[str]:
    """Run a command that prints to a descriptor."""
    environment = {**os.environ, "PYTHONUNBUFFERED": unbuffered}
    return run_command([*RACK, *arguments], BOUND_S, stdout=stdout, env=environment, text=True)


@pytest.mark.slow
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_failed_output_is_reported_in_one_line_and_a_closed_pipe_is_no_error(
    small: Path, rack_name: str, unbuffered: str
) -> None:
    *short, run = outputs(small, rack_name)
    # A run prints as a check does: one mode of its stream is enough.
    for arguments in [*short, ("report", "--help"), *[run] * (not unbuffered)]:
        with Path("/dev/full").open("wb") as full:
            done = printed_to(full.fileno(), arguments, unbuffered)
        *before, last = done.stderr.splitlines()
        assert (done.returncode, last) == (1, "stdout: No space left on device"), arguments
        # Of a rack that does not exist there is a reason, too, and of a run its progress.
        assert [line for line in before if rack_name not in line] == []
        reader, writer = os.pipe()
        os.close(reader)
        done = printed_to(writer, arguments, unbuffered)
        os.close(writer)
        assert done.returncode == 1, arguments
        assert [line for line in done.stderr.splitlines() if rack_name not in line] == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "answer"),
    [
        (("list",), ""),
        (("check", "nasrem"), "the working folder has been removed; change to another one"),
        (("robot", "new", "arm.xml"), "the working folder has been removed; change to another one"),
    ],
)
def test_in_a_removed_working_folder_a_command_works_or_says_why_not(
    tmp_path: Path, arguments: tuple[str, ...], answer: str
) -> None:
    command = shlex.join([*RACK, *arguments])
    script = f'cd "{tmp_path}" && rmdir "{tmp_path}" && exec {command}'
    done = run_process(["sh", "-c", script])
    assert (done.stderr.strip(), done.returncode) == (answer, 2 if answer else 0)


@pytest.mark.slow
def test_with_stdin_closed_a_command_that_reads_it_says_so(run: Path) -> None:
    line = ["sh", "-c", '"$@" <&-', "sh", *RACK, "rewind", str(run)]
    said = "stdin is closed, and this command reads from it"
    assert read_refusal(run_process(line)) == said


@pytest.mark.slow
def test_with_stdout_closed_commands_do_what_they_do(small: Path, rack_name: str) -> None:
    # One that fails and one that starts processes.
    for arguments in outputs(small, rack_name)[-2:]:
        # Python itself closes what the shell has closed before it starts.
        line = ["sh", "-c", '"$@" >&-', "sh", *RACK, *arguments]
        done = run_process(line)
        refused = int(arguments[0] == "status")
        # On a slow machine it also says what it waits for.
        progress = (rack_name, "waiting: ")
        said = [line for line in done.stderr.splitlines() if not line.startswith(progress)]
        assert (done.returncode, len(said)) == (refused, refused), done.stderr


@pytest.mark.parametrize("command", ["status", "stop", "record", "estop", "command", "inject"])
def test_an_empty_name_is_refused_and_an_unknown_rack_is_named(
    command: str, rack_name: str
) -> None:
    rest = {"command": ("upper", "hold"), "inject": ("wave", "kill")}.get(command, ())
    permitted = 'must be the name of a running rack, as "rack list" shows it'
    assert read_refusal(rack(command, "", *rest)) == f'RACK = "": {permitted}'
    refusal = read_refusal(rack(command, rack_name, *rest), status=1)
    assert f"rack '{rack_name}' does not exist" in refusal


def test_help_has_a_whole_line_for_every_command_by_groups() -> None:
    listed = "".join(
        f" {group}: " + "".join(f"{name} {line} " for name, line in found.items())
        for group, found in COMMANDS.items()
    )
    assert len({*NAMES}) == len(NAMES)
    assert "".join(listed.split()) in "".join(rack("--help").stdout.split())


def test_the_help_line_of_export_names_every_kind_of_file() -> None:
    line = COMMANDS["Watch"]["export"].lower()
    assert [kind for kind in EXPORTERS if kind not in line] == []


def test_the_printed_version_equals_the_version_of_the_project() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert rack("--version").stdout == f"rack {project['version']}\n"


def test_bytes_that_are_not_utf_8_are_refused() -> None:
    refusal = read_refusal(run_process([*RACK, "check", b"\xff"]))
    assert refusal == 'argument 2 = "?": must be UTF-8'


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "found"),
    [("rack che", "check"), ("rack check fig", "fig2\nfig3\nfig4\nfig4-overload")],
)
def test_the_shell_completes_commands_and_configs(words: str, found: str) -> None:
    place = str(len(words.split()) - 1)
    asked = {"_RACK_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": place}
    done = run_process(RACK, **asked)
    assert (done.returncode, done.stdout.strip()) == (0, found)


def test_the_command_line_runs_as_a_module() -> None:
    done = run_process([sys.executable, "-m", "rack", "--version"])
    assert (done.returncode, done.stderr, done.stdout[:5]) == (0, "", "rack ")


def test_help_without_its_texts_gives_the_reason() -> None:
    assert run_process([sys.executable, "-m", "rack", "list", "--help"]).stderr == ""
    assert run_process([sys.executable, "-OO", "-m", "rack", "list", "--help"]).stderr == (
        "help lacks its texts: PYTHONOPTIMIZE=2 (python -OO) removes them\n"
    )
