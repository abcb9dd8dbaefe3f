"""Configs of cells: mailboxes made for the arms, and one line for each mistake."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.boards.config import load, resolve
from rack.boards.errors import ConfigError

RACK = """
format = 2
name = "cell"
[clock]
period_ms = 2.5
mode = "lockstep"
[board.task]
slot = 2
rate_hz = 4
executor = "rack.levels.systems.coordination:Coordinator"
ends_run = true
[board.task.params]
arms = { puma = "lan.puma", k1607 = "lan.k1607" }
[adapter.lan]
slot = 3
rate_hz = 20
connect = ["unix/cell-puma"]
[adapter.lan.export.puma]
from = "task.order_puma"
[adapter.lan.import.puma]
from = "cell-puma/task.report"
type = "rack.levels.systems.coordination.messages:CellReport"
max_age_ms = 500
[adapter.lan.import.k1607]
from = "cell-k1607/task.report"
type = "rack.levels.systems.coordination.messages:CellReport"
max_age_ms = 500
[[task.step]]
do = [
    { arm = "puma", do = "home", by = 20.0 },
    { arm = "k1607", do = "goto", position = [0.8, 0.5, 0.2], by = 15.0 },
]
[[task.step]]
do = [{ arm = "puma", do = "home", by = 30.0 }]
"""


def mistakes(folder: Path, *changes: tuple[str, str]) -> str:
    """Return all mistakes of the rack after these changes of its text, as `rack check` reports
    them."""
    text = RACK
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "cell.toml").write_text(text)
    with pytest.raises(ConfigError) as caught:
        resolve(load(folder / "cell.toml"))
    return str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "line"),
    [
        (
            ', k1607 = "lan.k1607" }',
            " }",
            "board.task.params.arms = \"puma\": lacks 'k1607', the arm of task.step[0].do[1]",
        ),
        (
            'arm = "k1607"',
            'arm = "puma"',
            ('task.step[0].do[1].arm = "puma": this arm already has an action in this step'),
        ),
        (
            "by = 30.0",
            "by = 20.0",
            "task.step[1].do[0].by = 20.0: must be later than 20, the time of an earlier step",
        ),
        (
            '[{ arm = "puma", do = "home", by = 30.0 }]',
            "[]",
            "task.step[1].do = []: a step must have at least one action",
        ),
        (
            'do = "home", by = 30.0',
            'do = "fly"',
            'task.step[1].do[0].do = "fly": valid values: transfer, goto, home',
        ),
        ('arm = "k1607", ', "", "task.step[0].do[1].arm: missing; arm that does it"),
        ("lan.k1607", "lan.other", "lan.other"),
        (
            'do = "home", by = 30.0',
            'do = "transfer", object = "a part whose name is longer than 32", to = [0, 0, 0]',
            (
                'task.step[1].do[0].object = "a part whose name is longer than 32": an order'
                " can contain at most 32 ASCII characters"
            ),
        ),
    ],
)
def test_each_mistake_in_a_coordinators_config_is_one_line(
    tmp_path: Path, old: str, new: str, line: str
) -> None:
    (found,) = mistakes(tmp_path, (old, new)).splitlines()
    assert line in found
