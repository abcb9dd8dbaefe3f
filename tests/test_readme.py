"""The pages as texts: length, form, lists and references to code are right, and each command has a
test. No command runs here (test_pages.py, test_guides.py), and links are tested with the site."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from rack.boards.faults import KINDS
from rack.tools import cli
from tests.pages import (
    BLOCK,
    CODE,
    GUIDES,
    LAYERS,
    PAGES,
    README,
    REFERENCES,
    ROOT,
    WITHOUT_COMMANDS,
    list_pages,
)
from tests.test_course import EXERCISES
from tests.test_examples import FOLDERS

TEXT = "\n".join(page.read_text() for page in PAGES)
README_LINES, MOST_LINES = 120, 430
LAYER_WORDS, MOST_WORDS = 900, 1500
MOST_FIGURES = 15
MOST_COLUMNS, MOST_PARAGRAPH_LINES = 100, 6
PICTURE_BYTES = 2_000_000
UNITS = (
    r"(?:%|[mun]?s|min|h|minutes?|hours?|seconds?|[kMG]?Hz|[mck]?m|kg|J|N|W|m?rad(?:/s)?"
    r"|degrees|[kMG]?B|kB/s)"
)
NUMBER = r"\d[\d,]*(?:\.\d+)?"
FIGURE = re.compile(rf"{NUMBER}(?:(?: to |, | and |-){NUMBER})* ?{UNITS}(?![\w/])")
"""A figure is a number with a unit of measurement, measured or quoted, in prose or in a table.
Numbers in code, of equations and of sections are none, nor are counts of things."""
NOT_RUN = {"CONTRIBUTING.md": "the commands of make"}
"""Pages with commands that no test runs, and the reason."""


def name_of(page: Path) -> str:
    return str(page.relative_to(ROOT))


def test_the_readme_is_a_front_door() -> None:
    assert len(README.read_text().splitlines()) <= README_LINES
    pictures = ROOT / ".github" / "pictures"
    assert all(picture.stat().st_size < PICTURE_BYTES for picture in pictures.iterdir())


@pytest.mark.parametrize("page", LAYERS, ids=name_of)
def test_the_page_of_a_layer_can_be_read_to_its_end(page: Path) -> None:
    text = page.read_text()
    figures = FIGURE.findall(CODE.sub("", text))
    counted = [number for figure in figures for number in re.findall(NUMBER, figure)]
    assert len(text.split()) <= LAYER_WORDS
    assert len(counted) <= MOST_FIGURES, figures


def test_every_other_page_has_one_subject_but_the_list_of_measured_figures() -> None:
    texts = {page.name: page.read_text() for page in PAGES if page.name != "MEASURED.md"}
    assert not [name for name, text in texts.items() if len(text.split()) > MOST_WORDS]
    assert not [name for name, text in texts.items() if len(text.splitlines()) > MOST_LINES]


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_page_can_be_read_in_an_editor(page: Path) -> None:
    # Tables, pictures, links, commands and their output are as wide as they are.
    prose = CODE.sub("", page.read_text())
    paragraphs = [part.splitlines() for part in re.split(r"\n\s*\n|\n(?=- |\d\. )", prose)]
    wide = [
        line
        for part in paragraphs
        for line in part
        if len(line) > MOST_COLUMNS and not re.match(r"\||!?\[[^]]*\]\(\S+\)$", line)
    ]
    assert not wide
    long = [
        part
        for part in paragraphs
        if len(part) > MOST_PARAGRAPH_LINES and not part[0].startswith(("|", ":::"))
    ]
    assert not long


def test_every_page_with_commands_has_a_test() -> None:
    covered = {
        *GUIDES,
        *NOT_RUN,
        *map(name_of, REFERENCES),
        *(f"configs/course/{name}/README.md" for name in EXERCISES),
        "configs/course/answers.md",
        *(f"configs/examples/{name}/README.md" for name in FOLDERS),
    }
    assert not covered & {*WITHOUT_COMMANDS}
    listed = list_pages()
    assert {*GUIDES, *WITHOUT_COMMANDS} <= {*listed}
    shell = re.compile(r"^ *```sh$", re.MULTILINE)
    assert not [
        name for name in listed if name not in covered and shell.search((ROOT / name).read_text())
    ]


def test_the_table_of_commands_is_complete() -> None:
    table = (ROOT / "tools" / "README.md").read_text().partition("## Commands")[2]
    rows = re.findall(r"^\| ([a-z ]+) \| (`.*`) \|$", table, re.MULTILINE)
    listed = {goal.capitalize(): tuple(re.findall(r"`(\w+)`", names)) for goal, names in rows}
    assert listed == {group: tuple(found) for group, found in cli.COMMANDS.items()}


def test_the_pages_count_the_kinds_of_faults() -> None:
    counts = re.findall(r"(\d+) kinds", TEXT)
    assert len(counts) >= 2
    assert {int(count) for count in counts if int(count) > 20} == {len([*KINDS])}


def test_the_example_level_is_the_one_in_configs() -> None:
    own_level = ROOT / "configs" / "examples" / "own-level"
    shown = [(name, block) for name, block in BLOCK.findall(TEXT) if (own_level / name).exists()]
    assert {name for name, _ in shown} == {"power.py", "metered.toml"}
    for name, block in shown:
        assert block == (own_level / name).read_text()


def test_the_page_of_each_historical_system_ends_with_what_is_not_modelled() -> None:
    configs = ROOT / "configs"
    table = (configs / "SYSTEMS.md").read_text().partition("\n## ")[0]
    links = re.findall(r"^\| \[`[\w-]+`\]\(([\w.-]+)\)", table, re.MULTILINE)
    assert len(links) == 9
    for link in links:
        page = configs / link
        text = (page / "README.md" if page.is_dir() else page).read_text()
        title, _, items = text.rpartition("\n## ")[2].partition("\n")
        assert title == "Not modelled", link
        assert items.strip().startswith("- "), link
        assert 2 <= len(re.findall(r"^- ", items, re.MULTILINE)) <= 6, link


def test_the_map_names_every_package_and_no_other_on_one_page() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text()
    named = re.findall(r"^\| `([\w/]+)` \|", text, re.MULTILINE)
    floors = ("backplane", "boards", "levels", "tools")
    found = {
        str(path.parent.relative_to(ROOT))
        for floor in floors
        for path in (ROOT / floor).rglob("__init__.py")
    }
    # `rack` itself is made from the folder of its one file.
    assert sorted(named) == sorted(found - {"tools/front/rack"} | {"configs", "tools/front"})
    lines = text.splitlines()
    assert len(lines) <= 120
    assert max(map(len, lines)) <= 100


def test_every_name_that_a_page_links_to_code_is_in_that_file() -> None:
    pages = {*PAGES, *ROOT.glob("*.md"), *(ROOT / "configs").rglob("*.md")}
    named = [
        (page, name, link)
        for page in pages
        for name, link in re.findall(r"\[`(\w+)`\]\(([\w/.-]+\.py)\)", page.read_text())
    ]
    assert named
    assert not [
        entry
        for entry in named
        if not re.search(rf"\b{entry[1]}\b", (entry[0].parent / entry[2]).read_text())
    ]


def test_every_measured_figure_has_a_date_a_commit_and_a_command() -> None:
    text = (ROOT / "tools" / "MEASURED.md").read_text()
    rows = re.findall(r"^\| (?!bench \||figure \||-)(.+) \|$", text, re.MULTILINE)
    cells = [re.split(r"\s*\|\s*", row) for row in rows if not row.startswith("---")]
    assert cells
    assert not [row for row in cells if len(row) not in (4, 6) or not row[0] or not row[1]]
    assert not [row for row in cells if not re.fullmatch(r"\d{4}-\d\d-\d\d", row[-2])]
    assert not [row for row in cells if not re.fullmatch(r"[0-9a-f]{8}", row[-1])]
