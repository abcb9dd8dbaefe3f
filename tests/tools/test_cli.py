"""The command line before any command: arguments that none can use, paths that cannot be, completion by the shell."""

from __future__ import annotations

import os
import subprocess

import pytest

from tests.processes import RACK
from tests.tools.command_line import BOUND_S, ROOT, rack

LONG = "a" * 5000
COMMANDS = (
    ("check", LONG),
    ("run", "fig2", "--set", f"clock.speed={LONG}"),
    ("run", "fig2", "--out", LONG),
    ("check", "fig2", "--faults", LONG),
    ("status", LONG),
    ("command", LONG, "task", "hold"),
    ("inject", "fig2", LONG, "kill"),
    ("report", LONG),
    ("bench", "partition", LONG),
    (LONG,),
)


@pytest.mark.parametrize("arguments", COMMANDS, ids=lambda arguments: " ".join(arguments)[:20])
def test_an_argument_without_end_is_refused_in_one_line(arguments: tuple[str, ...]) -> None:
    done = rack(*arguments)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("argument ")
    assert done.stderr.endswith(" characters; at most 4096\n")
    assert len(done.stderr) < 200


@pytest.mark.parametrize("arguments", [("report",), ("analyze",), ("replay",), ("gantt",), ("run", "fig2", "--out")])
def test_a_name_that_no_file_can_have_is_refused_in_one_line(arguments: tuple[str, ...]) -> None:
    done = rack(*arguments, "a" * 300)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "aaaaaaaa" in done.stderr


@pytest.mark.parametrize("seconds", ["inf", "nan", "1e300", "-1"])
def test_no_run_lasts_for_ever_or_less_than_nothing(seconds: str) -> None:
    done = rack("run", "fig2", "--lockstep", "--no-record", "--seconds", seconds)
    assert (done.returncode, done.stdout) == (2, "")
    assert "Invalid value for '--seconds'" in done.stderr


@pytest.mark.parametrize("command", ["status", "stop", "record", "estop", "command", "inject"])
def test_an_empty_name_is_no_rack(command: str) -> None:
    done = rack(command, "")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == 'RACK = "": empty; permitted: a running rack by name, as "rack list" shows it\n'


@pytest.mark.parametrize("option", ["--faultless=nan", "--faultless=inf", "--faultless=-1", "--seconds=inf"])
def test_no_campaign_lasts_for_ever_or_less_than_nothing(option: str) -> None:
    done = rack("campaign", "fig2", option)
    assert (done.returncode, done.stdout) == (2, "")
    assert f"Invalid value for '{option.partition('=')[0]}'" in done.stderr


def test_bytes_that_are_no_text_are_refused() -> None:
    command = [*RACK, "check", b"\xff"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=BOUND_S, check=False)
    assert (done.returncode, done.stderr) == (2, 'argument 2 = "?": not UTF-8\n')


@pytest.mark.parametrize(
    ("words", "found"), [("rack che", "check"), ("rack check fig", "fig2\nfig3\nfig4\nfig4-overload")]
)
def test_the_shell_completes_commands_and_configs(words: str, found: str) -> None:
    asked = {"_RACK_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(len(words.split()) - 1)}
    command = list(RACK)
    done = subprocess.run(
        command, cwd=ROOT, env=os.environ | asked, capture_output=True, text=True, timeout=BOUND_S, check=False
    )
    assert (done.returncode, done.stdout.strip()) == (0, found)
