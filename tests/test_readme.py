"""The README and the floors' pages are true: their commands run, as does the example level, as it
stands there. Commands that need a run or a running rack: test_pages.py."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from rack.boards.faults import KINDS
from rack.tools import cli
from tests.shared_runs import nasrem_run
from tests.tools.command_line import rack

pytestmark = pytest.mark.thorough

OWN_NAME = f"readme-{os.getpid()}"
TO_ITS_END = "k1607"
"""The rack of which the whole run is made and recorded."""
README = Path(__file__).parent.parent / "README.md"
FLOORS = ("backplane", "boards", "levels", "configs", "tools")
WRITTEN_BY_PROGRAM = "REFERENCE.md"
GUIDES = ("TUTORIAL.md", "ANNOTATED.md", "API.md", "TROUBLESHOOTING.md", "COMPARISON.md")
"""Pages that test_guides.py runs."""
PAGES = [
    README,
    README.parent / "ARCHITECTURE.md",
    *(
        page
        for floor in FLOORS
        for page in sorted((README.parent / floor).glob("*.md"))
        if page.name not in (WRITTEN_BY_PROGRAM, *GUIDES)
    ),
]
TEXT = "\n".join(page.read_text() for page in PAGES)
MOST_LINES, MOST_WORDS, MOST_PAGE_LINES = 120, 1500, 430
BLOCK = re.compile(r"<!-- test: (\S+) -->\n```\w+\n(.*?)```", re.DOTALL)

CODE = re.compile(r"```.*?```", re.DOTALL)
SHELL = re.compile(r"```sh\n(.*?)```", re.DOTALL)
ELSEWHERE = re.compile(
    r"<|\.toml|RUN|rack"
    r" (status|top|watch|mailbox|stop|pause|resume|set|record|replay|rewind|inject|estop)"
    r"|rack (command|prompt|campaign|export|bench (?!mailbox))"
    r"|kill-each-board|--view|--step"
    r"|reproduce|rack run (arm|cell|brown)|rack lan"
)
"""Commands that need a run, or a running rack, of another line: test_pages.py runs them, or names
the test that does."""
COMMANDS = {
    line.partition("#")[0].strip(): int("exit status 1" in line)
    for block in SHELL.findall(TEXT)
    for line in block.splitlines()
    if line.startswith("rack ") and not ELSEWHERE.search(line.partition("#")[0])
}


def words_of(command: list[str]) -> list[str]:
    """Return the words of a command for a test; of an option that is given twice the last one
    counts."""
    if command == ["bench", "mailbox"]:
        return [*command, "--rounds", "20"]
    if command[0] != "run":
        return command
    # A rack of the same name may be at work on this machine. What the racks do is asserted by
    # test_golden.py.
    seconds = "2" if "--lockstep" in command else "1"
    shorter = [] if command[1] == TO_ITS_END else ["--seconds", seconds, "--no-record"]
    # The machine may be too busy to be in time.
    settings = ("--set", f"name={OWN_NAME}", "--set", "supervision.max_missed_fraction=1")
    return [*command, *settings, "--share", *shorter]


def python(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *words]
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=55, check=False
    )


@pytest.mark.slow
@pytest.mark.usefixtures("without_templates")
@pytest.mark.parametrize(("line", "status"), COMMANDS.items(), ids=COMMANDS)
def test_command_of_the_pages_works(line: str, status: int, tmp_path: Path) -> None:
    ended = rack(*words_of(line.split()[1:]), folder=tmp_path)
    assert ended.returncode == status, ended.stderr


def test_the_pages_show_the_commands() -> None:
    assert {"run", "check", "list", "clean", "bench", "gantt"} <= {
        line.split()[1] for line in COMMANDS
    }
    table = (README.parent / "tools" / "README.md").read_text().partition("## Commands")[2]
    rows = re.findall(r"^\| ([a-z ]+) \| (`.*`) \|$", table, re.MULTILINE)
    listed = {goal.capitalize(): tuple(re.findall(r"`(\w+)`", names)) for goal, names in rows}
    assert listed == {group: tuple(found) for group, found in cli.COMMANDS.items()}


def test_the_pages_count_the_kinds_of_faults() -> None:
    counts = re.findall(r"(\d+) kinds", TEXT)
    assert len(counts) >= 2
    assert {int(count) for count in counts if int(count) > 20} == {len([*KINDS])}


def test_the_readme_is_a_front_door_and_pages_have_an_end() -> None:
    text = README.read_text()
    assert len(text.splitlines()) <= MOST_LINES
    assert len(text.split()) <= MOST_WORDS
    assert all(len(page.read_text().splitlines()) <= MOST_PAGE_LINES for page in PAGES)
    pictures = README.parent / ".github" / "pictures"
    assert all(picture.stat().st_size < 2_000_000 for picture in pictures.iterdir())


def test_the_example_level_is_the_one_in_configs() -> None:
    own_level = README.parent / "configs" / "examples" / "own-level"
    shown = [(name, block) for name, block in BLOCK.findall(TEXT) if (own_level / name).exists()]
    assert {name for name, _ in shown} == {"power.py", "metered.toml"}
    for name, block in shown:
        assert block == (own_level / name).read_text()


def pages() -> list[Path]:
    """Return all pages of the project."""
    root = README.parent
    return [*root.glob("*.md"), *PAGES[2:], *(root / "configs").rglob("*.md")]


def test_the_page_of_each_historical_system_ends_with_what_is_not_modelled() -> None:
    configs = README.parent / "configs"
    table = (configs / "README.md").read_text().partition("## The systems of its time")[2]
    links = re.findall(r"^\| \[`[\w-]+`\]\(([\w.-]+)\)", table, re.MULTILINE)
    assert len(links) == 9
    for link in links:
        page = configs / link
        text = (page / "README.md" if page.is_dir() else page).read_text()
        title, _, items = text.rpartition("\n## ")[2].partition("\n")
        assert title == "Not modelled", link
        assert items.strip().startswith("- "), link
        assert 2 <= len(re.findall(r"^- ", items, re.MULTILINE)) <= 6, link


def test_every_file_that_the_pages_link_to_exists() -> None:
    links = [
        (page, link)
        for page in pages()
        for link in re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text())
    ]
    assert links
    assert not [f"{page.name}: {link}" for page, link in links if not (page.parent / link).exists()]


def anchors(page: Path) -> set[str]:
    """Return the anchors of the headings of a page, as GitHub makes them."""
    headings = re.findall(r"^#+ (.*)$", CODE.sub("", page.read_text()), re.MULTILINE)
    return {re.sub(r"[^\w -]", "", text.lower()).replace(" ", "-") for text in headings}


def test_every_heading_that_the_pages_link_to_exists() -> None:
    links = [
        (page, page.parent / file if file else page, anchor)
        for page in pages()
        for file, anchor in re.findall(
            r"\]\((?!https?:)([^)#\s]*)#([^)]+)\)", CODE.sub("", page.read_text())
        )
    ]
    assert links
    assert not [
        f"{page.name}: {target.name}#{anchor}"
        for page, target, anchor in links
        if anchor not in anchors(target)
    ]


def test_the_map_names_every_package_and_no_other_on_one_page() -> None:
    root = README.parent
    text = (root / "ARCHITECTURE.md").read_text()
    named = re.findall(r"^\| `([\w/]+)` \|", text, re.MULTILINE)
    floors = ("backplane", "boards", "levels", "tools")
    found = {
        str(path.parent.relative_to(root))
        for floor in floors
        for path in (root / floor).rglob("__init__.py")
    }
    # `rack` itself is made from the folder of its one file.
    assert sorted(named) == sorted(found - {"tools/front/rack"} | {"configs", "tools/front"})
    lines = text.splitlines()
    assert len(lines) <= 120
    assert max(map(len, lines)) <= 100


@pytest.mark.slow
def test_the_python_way_in_runs_as_the_readme_has_it(tmp_path: Path) -> None:
    script = re.search(r"```python\n(from rack\.boards.*?)```", TEXT, re.DOTALL)
    assert script
    named = (
        script[1]
        .replace('["clock', f'["name={OWN_NAME}", "clock')
        .replace("seconds=10", "seconds=1")
    )
    (tmp_path / "script.py").write_text(named)
    ended = python(tmp_path, "script.py")
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.startswith("time over 400 ")


@pytest.mark.slow
def test_the_script_of_the_readme_plots_a_killed_board(tmp_path: Path) -> None:
    (script,) = re.findall(r"```python\n(import rack\n.*?)```", README.read_text(), re.DOTALL)
    assert len(script.splitlines()) <= 15
    # A rack of the same name may be at work on this machine; pictures need no screen.
    named = script.replace('"seed"', f'"name": "{OWN_NAME}", "seed"')
    named = named.replace('attach("nasrem")', f'attach("{OWN_NAME}")')
    (tmp_path / "script.py").write_text(named)
    ended = python(tmp_path, "script.py")
    assert ended.returncode == 0, ended.stderr
    printed = ended.stdout.splitlines()
    assert len(printed) == 2
    assert printed[0].startswith("'primitive' rejoined after ")
    assert printed[1] == "time over"
    assert (tmp_path / "velocity.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
def test_a_run_reads_back_as_the_readme_has_it(
    tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    nasrem_run(tmp_path_factory).rename(tmp_path / "run")
    block = re.search(r"```python\n(from pathlib.*?)```", TEXT, re.DOTALL)
    assert block
    script = block[1].replace("runs/nasrem-20250101-120000", "run")
    script += "\nprint(ticks.shape, measured.shape, error.values.shape[1], len(lateness) > 0)"
    (tmp_path / "read.py").write_text(script)
    read = python(tmp_path, "read.py")
    assert read.returncode == 0, read.stderr
    assert read.stdout == "(2600,) (2600, 6) 6 True\n"


def test_every_name_that_a_page_links_to_code_is_in_that_file() -> None:
    named = [
        (page, name, link)
        for page in pages()
        for name, link in re.findall(r"\[`(\w+)`\]\(([\w/.-]+\.py)\)", page.read_text())
    ]
    assert named
    assert not [
        entry
        for entry in named
        if not re.search(rf"\b{entry[1]}\b", (entry[0].parent / entry[2]).read_text())
    ]
