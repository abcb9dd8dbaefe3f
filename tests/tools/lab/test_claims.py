"""Pages show no measured figure that the ledger of claims lacks, and no claim is much older than
what it measures."""

from __future__ import annotations

import json
import re
import subprocess
import tomllib
from collections.abc import Iterator
from dataclasses import replace
from datetime import date, timedelta
from pathlib import Path

import pytest

from rack.tools.commands import claims as command
from rack.tools.lab import claims
from rack.tools.lab.claims import MOST_LAG_DAYS, MeasuredClaim, read_ledger, standing, taken
from tests.tools.command_line import ROOT, rack

SETTINGS = tomllib.loads(Path(__file__).with_name("settings.toml").read_text())
"""Texts with numbers that nobody measured, by page: settings, limits, arithmetic, the paper's."""
LEDGER = read_ledger()
FLOORS = ("backplane", "levels", "boards", "configs", "tools")
WITHOUT = ("CHANGELOG.md", "configs/REFERENCE.md", "configs/course/")
"""Pages without figures to look for: a history, whose figures are those of its day; one made from
the keys of configs; the course, of which tests/test_course.py compares what its commands print."""
PAGES = [
    page
    for path in sorted((*ROOT.glob("*.md"), *(p for f in FLOORS for p in (ROOT / f).rglob("*.md"))))
    if not (page := str(path.relative_to(ROOT))).startswith(WITHOUT)
]
UNITS = (
    r"ns|us|µs|ms|s|min|minutes?|h|hours?|B|kB|MB|GB|kB/s|MB/s|k/s|Mbit/s|ms/s|%|times|\u00d7|mm|m"
    r"|mrad|rad|rad/s|N m|N|J|kg|ticks|cycles|cores?|lines|kills|runs"
)
"""Without Hz: rates are settings."""
WORDS = "half an?|two|three|four|five|six|seven|eight|nine|ten|eleven|twelve"
FIGURE = re.compile(
    rf"(?<![\w.,-])\d[\d,.]*(?: (?:to|and|of|or) \d[\d,.]*)? ?(?:{UNITS})(?![\w/])"
    rf"|\b(?:under a|{WORDS}) minutes?\b"
    r"|\b\d[\d,]* of \d[\d,]*"
    r"|(?<=\| )\d[^|]*(?= \|)"
)
"""A number with a unit, a part of a number, or one at the head of a cell. Bare counts pass."""
CODE = re.compile(r"^```.*?^```$|^    .*?$", re.DOTALL | re.MULTILINE)


def known_on(page: str) -> list[str]:
    """Return the texts of a page that are claims or settings."""
    shown = [text for claim in LEDGER.values() for text in claim.shown.get(page, ())]
    return [*shown, *SETTINGS.get(page, ())]


def unknown_figures(text: str, known: list[str]) -> list[str]:
    """Return what looks like a measured figure on a page, outside its code and what is known."""
    text = " ".join(CODE.sub("", text).split())
    for entry in sorted(known, key=len, reverse=True):
        text = re.sub(rf"(?<![\d.,]){re.escape(entry)}(?!\w)", "", text)
    return FIGURE.findall(re.sub(r"`[^`]*`", "`", text))


def text_of(page: str) -> str:
    return (ROOT / page).read_text()


@pytest.mark.parametrize("page", PAGES)
def test_every_figure_on_a_page_is_a_claim_or_a_setting(page: str) -> None:
    assert not unknown_figures(text_of(page), known_on(page))


def test_a_page_with_an_invented_figure_is_found() -> None:
    page = "tools/README.md"
    invented = "A launch takes 0.93 s, 1.7\ntimes as long, 3 of 40 fail;\n\n| `bench` | 4.2 |\n"
    found = unknown_figures(f"{text_of(page)}\n{invented}", known_on(page))
    assert found == ["0.93 s", "1.7 times", "3 of 40", "4.2"]


def test_a_figure_that_was_changed_on_its_page_alone_is_found() -> None:
    page = "README.md"
    changed = text_of(page).replace("costs 1.58 us", "costs 1.38 us")
    assert unknown_figures(changed, known_on(page)) == ["1.38 us"]
    # A known text does not cover the end of a longer number.
    assert unknown_figures("it takes 35 ms", ["5 ms"]) == ["35 ms"]


@pytest.mark.parametrize(
    "page", sorted({*SETTINGS, *(page for claim in LEDGER.values() for page in claim.shown)})
)
def test_claims_and_settings_stand_on_their_pages(page: str) -> None:
    text = " ".join(text_of(page).split())
    assert not [entry for entry in known_on(page) if entry not in text]


def test_claims_are_whole() -> None:
    for claim in LEDGER.values():
        assert (ROOT / claim.room).exists(), claim.name
        assert claim.shown, claim.name
        assert bool(claim.command) == bool(claim.take) != bool(claim.how), claim.name
        low, high = claim.permitted
        assert low <= claim.figure <= high, claim.name


def test_no_claim_is_much_older_than_the_last_change_of_its_room() -> None:
    found = [standing(claim, date.today()) for claim in LEDGER.values()]
    if all(one.changes_since is None for one in found):
        pytest.skip("the history of this checkout is not whole, or git is not installed")
    assert not [one.claim.name for one in found if one.changes_since is None]
    overdue = [one.claim.name for one in found if one.is_overdue]
    assert not overdue, "measure these anew, by `rack claims --again NAME`, or take them off"


@pytest.fixture
def old_claim(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[MeasuredClaim]:
    """A claim on `room`, in a checkout of its own."""
    for cached in (claims._history, claims._commits_since):
        cached.cache_clear()
    monkeypatch.setattr(claims, "ROOT", tmp_path)
    git(tmp_path, "init", "--quiet")
    commit(tmp_path, "room/level.py", 0)
    name = git(tmp_path, "rev-parse", "--short", "HEAD").strip()
    yield replace(LEDGER["message-200-bytes"], room="room", date=date(2026, 1, 1), commit=name)
    for cached in (claims._history, claims._commits_since):
        cached.cache_clear()


def git(folder: Path, *words: str, day: str = "2026-01-01") -> str:
    """Run git as somebody, on a day."""
    who = ["-c", "user.name=a", "-c", "user.email=a@b"]
    done = subprocess.run(
        ["git", *who, *words],
        cwd=folder,
        env={"PATH": "/usr/bin:/bin", "GIT_COMMITTER_DATE": f"{day}T12:00:00+0000"},
        capture_output=True,
        text=True,
        timeout=30,
        check=True,
    )
    return done.stdout


def commit(folder: Path, file: str, days: int) -> None:
    """Change a file, so many days after the first of January."""
    (folder / file).parent.mkdir(exist_ok=True)
    (folder / file).write_text(f"{days}\n")
    git(folder, "add", file)
    day = date(2026, 1, 1) + timedelta(days=days)
    git(folder, "commit", "--quiet", "-m", "a change", day=str(day))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("days", "is_overdue"), [(MOST_LAG_DAYS, False), (MOST_LAG_DAYS + 1, True)]
)
def test_a_claim_is_overdue_once_its_room_has_changed_long_after_it(
    days: int, is_overdue: bool, old_claim: MeasuredClaim, tmp_path: Path
) -> None:
    commit(tmp_path, "roomier/level.py", days + 30)
    commit(tmp_path, "room/level.py", days)
    found = standing(old_claim, old_claim.date + timedelta(days=100))
    assert (found.age_days, found.changes_since) == (100, 1)
    assert found.is_overdue == is_overdue


@pytest.mark.slow
def test_a_claim_is_not_overdue_while_its_room_stays_as_it_was(
    old_claim: MeasuredClaim, tmp_path: Path
) -> None:
    commit(tmp_path, "other/level.py", 1000)
    found = standing(old_claim, old_claim.date + timedelta(days=1000))
    assert (found.age_days, found.changes_since, found.is_overdue) == (1000, 0, False)


@pytest.mark.slow
def test_a_shallow_clone_says_nothing_of_changes(
    old_claim: MeasuredClaim, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commit(tmp_path, "room/level.py", MOST_LAG_DAYS + 1)
    git(tmp_path, "clone", "--quiet", "--depth", "1", f"file://{tmp_path}", "shallow")
    monkeypatch.setattr(claims, "ROOT", tmp_path / "shallow")
    found = standing(old_claim, old_claim.date)
    assert (found.changes_since, found.is_overdue) == (None, False)


def test_a_figure_is_found_by_key_position_and_what_an_item_has() -> None:
    samples = [{"case": "a", "who": "us", "median": 1.0}, {"case": "b", "who": "us", "median": 2.5}]
    assert taken({"samples": samples}, ["samples", {"case": "b"}, "median"]) == 2.5
    assert taken({"samples": samples}, ["samples", 0, "median"]) == 1.0
    with pytest.raises(ValueError, match="too many"):
        taken({"samples": samples}, ["samples", {"who": "us"}, "median"])


def test_the_command_lists_claims() -> None:
    listed = rack("claims")
    assert listed.returncode == 0
    assert all(re.search(rf"^{name} ", listed.stdout, re.MULTILINE) for name in LEDGER)
    (one,) = json.loads(rack("claims", "tracking", "--json").stdout)
    assert one["figure"] == LEDGER["tracking"].figure
    assert one["age_days"] == (date.today() - LEDGER["tracking"].date).days
    assert "levels/README.md: | torque |" in rack("claims", "tracking").stdout


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("message-200-byte",), "message-200-byte: no such claim; nearest: message-200-bytes"),
        (("--again",), "--again needs one NAME"),
        (("--again", "tracking", "launch"), "--again needs one NAME"),
        (("--again", "arms-tried"), "no command repeats it: rack robot new MODEL"),
    ],
)
def test_what_cannot_be_done_is_a_line(words: tuple[str, ...], reason: str) -> None:
    done = rack("claims", *words)
    assert done.returncode == 2
    assert reason in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(("figure", "verdict"), [(0.375, "within"), (0.25, "outside")])
def test_a_claim_is_measured_anew(
    figure: float, verdict: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    claim = replace(LEDGER["monitors-stand"], figure=figure, spread=(figure, figure))
    monkeypatch.setattr(command, "read_ledger", lambda: {claim.name: claim})
    done = rack("claims", "--again", claim.name)
    assert done.returncode == (verdict == "outside"), done.stderr
    assert f"2026-11-25: {figure} mrad" in done.stdout
    assert f"now: 0.375 mrad, {0.375 / figure:.2f} times: {verdict}" in done.stdout


@pytest.mark.slow
def test_a_command_without_the_figure_is_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    claim = replace(LEDGER["monitors-stand"], command="rack check nothing-such")
    monkeypatch.setattr(command, "read_ledger", lambda: {claim.name: claim})
    done = rack("claims", "--again", claim.name)
    assert done.returncode == 1
    assert "`rack check nothing-such` gave no figure at ['monitors'" in done.stderr
