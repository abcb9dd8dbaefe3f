"""Guides, such as the tutorial, can be followed: their commands run from the first to the last, as
the pages have them, and print the lines that the pages show. Reference pages: test_pages.py."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent

import pytest

from tests.pages import GUIDES, ROOT
from tests.processes import run_to_end, wait_until
from tests.test_course import is_shown
from tests.tools.command_line import rack

pytestmark = pytest.mark.thorough

BLOCK = re.compile(
    r"(?:^ *<!-- test: (?P<mark>[\w .-]+) -->\n)?"
    r"^(?P<indent> *)```(?P<language>sh|python|toml)\n(?P<code>.*?)^ *```\n"
    r"(?:\n```\n(?P<shown>.*?)```)?",
    re.DOTALL | re.MULTILINE,
)
"""Commands, and lines that they print: "..." stands for anything."""
BOUND_S = 200
LAUNCH_S = 60
NAMES = "nasrem|hardware|chimera"
"""Racks that pages launch under a name that another test may use at the same time."""
ENDLESS = " --seconds 300"
NO_END = " --set board.task.ends_run=false"
"""For a run in another terminal: on a busy machine the page's commands may take longer than its
task."""
SHORT = " --seconds 2 --no-record"
"""For a run whose length and recording no later command of the page needs."""


def commands(code: str) -> Iterator[str]:
    """Yield the commands of a block, each with its here-document."""
    lines = iter(code.splitlines())
    for line in lines:
        command = [line]
        if end := re.search(r"<<'(\w+)'", line):
            for text in lines:
                command.append(text)
                if text == end[1]:
                    break
        yield "\n".join(command)


def with_own_name(command: str, own: str) -> str:
    """Return a command for a rack of its own name, on a machine that may be too busy, and short."""
    command, hash_sign, remark = command.partition("  #")
    command = re.sub(
        rf"\brack (status|step|stop|estop|inject|watch|mailbox|command) ({NAMES})\b",
        rf"rack \1 {own}",
        command,
    )
    if command.startswith("rack stop"):
        command += " --wait 60"
    if command.startswith("rack run"):
        command += f" --set name={own} --set supervision.max_missed_fraction=1 --share"
        is_short = re.search(" --(seconds|out|no-record)", command)
        command += "" if is_short else SHORT
    return command + hash_sign + remark


class PageShell:
    """Runs the blocks of a page in a folder, one after the other."""

    def __init__(self, folder: Path, own: str) -> None:
        self.folder = folder
        self.own = own
        self.background: subprocess.Popen[bytes] | None = None
        self.log = folder / "background.txt"
        binaries = Path(sys.executable).parent
        path = f"{binaries}:{os.environ['PATH']}"
        self.environment = {**os.environ, "PATH": path, "MPLBACKEND": "agg", "COLUMNS": "100"}

    def start(self, command: str) -> None:
        """Run a command as in another terminal, and wait until its rack runs."""
        self.end()
        with self.log.open("w") as log:
            self.background = subprocess.Popen(
                ["bash", "-c", f"exec {command}"],
                cwd=self.folder,
                env=self.environment,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        wait_until(lambda: ": running" in rack("status", self.own).stdout, LAUNCH_S)

    def run(self, *words: str) -> tuple[int, str]:
        """Run a program; return its exit status and what it printed."""
        done = run_to_end(
            words, BOUND_S, cwd=self.folder, env=self.environment, stdin=subprocess.DEVNULL
        )
        return done.returncode, (done.stdout + done.stderr).replace(self.own, "nasrem")

    def end(self) -> None:
        """Wait for the end of the command in the other terminal."""
        if self.background is not None:
            assert self.background.wait(BOUND_S) in (0, 1)
            self.background = None


@pytest.fixture
def shell(tmp_path: Path) -> Iterator[PageShell]:
    # As in the project: the folder of a page's runs is two below that of the configs.
    (tmp_path / "configs").symlink_to(ROOT / "configs")
    folder = tmp_path / "runs" / "page"
    shutil.copytree(ROOT / "configs" / "examples" / "own-hardware", folder)
    made = PageShell(folder, f"page-{os.getpid()}")
    yield made
    if made.background is not None:
        # The page has failed.
        made.background.kill()
        made.background.wait(BOUND_S)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("name", GUIDES)
def test_guide_can_be_followed_to_its_end(name: str, shell: PageShell) -> None:
    blocks = list(BLOCK.finditer((ROOT / name).read_text()))
    assert blocks
    for block in blocks:
        code, mark, language = dedent(block["code"]), block["mark"] or "", block["language"]
        printed = ""
        if mark.startswith("file "):
            (shell.folder / mark.removeprefix("file ")).write_text(code)
        elif mark == "background":
            of_task = NO_END if "nasrem" in code else ""
            shell.start(with_own_name(code.strip(), shell.own) + of_task + ENDLESS)
        elif language == "python":
            named = code.replace(
                'Rack("nasrem"', f'Rack("nasrem", settings={{"name": "{shell.own}"}}'
            )
            status, printed = shell.run(sys.executable, "-c", named)
            assert status == 0, printed
        elif language == "sh":
            for command in commands(code):
                status, answer = shell.run("bash", "-c", with_own_name(command, shell.own))
                if "no picture: " in answer:
                    continue  # without a graphics driver
                printed += answer
                expected = re.search(r"# exit status (\d)", command)
                other = shell.log.read_text()[-2000:] if shell.background else ""
                wanted = int(expected[1] if expected else 0)
                assert status == wanted, f"{command}: {answer[-3000:]}\n{other}"
        shown = (block["shown"] or "").splitlines() if printed else []
        missing = [line for line in shown if not is_shown(line, printed)]
        assert not missing, f"{missing} after {code}: {printed[-5000:]}"
    shell.end()
