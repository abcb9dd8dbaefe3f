"""`[record]`: durations as text or numbers, and what makes no sense is refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.boards.config import load, load_text
from tests.boards.config.mistakes import find_mistake


def test_durations_are_text_or_seconds_and_survive_the_config_of_a_run(small: Path) -> None:
    config = load(small, ["record={ keep = '10 min', before = '500 ms', after = 2 }"])
    assert (config.record.keep, config.record.before, config.record.after) == (600.0, 0.5, 2.0)
    assert load_text(config.to_toml_text()).record == config.record


@pytest.mark.parametrize(
    ("table", "line"),
    [
        ("{ keep = '-3 s' }", 'record.keep = "-3 s": should be a time'),
        ("{ keep = 0.5 }", "record.keep = 0.5: should be greater than or equal to 1"),
        ("{ keep = '10 s', before = -1 }", "record.before = -1: should be greater"),
        ("{ before = 'nan s' }", 'record.before = "nan s": should be a time'),
        ("{ checkpoint_s = 5.0 }", "record.checkpoint_s = 5.0: unknown key"),
        ("{ keep = '8 s' }", "record: keep = 8 s is shorter than before + after = 10 s"),
        ("{ keep = '1 h' }", 'record.keep = "1 h": should be a time, as in "0.5s", "20ms"'),
    ],
)
def test_a_mistake_is_one_line(small: Path, table: str, line: str) -> None:
    assert find_mistake(small, f"record={table}").startswith(line)


def test_windows_around_events_need_a_flight_recorder(small: Path) -> None:
    found = find_mistake(small, "record={ before = '2 s' }")
    assert found == "record: before and after need keep; without it everything is kept"
