"""Limits of a config, at the very value: what is still permitted, and what no longer is."""

from __future__ import annotations

import pytest

from rack.backplane.address_map import AddressMap
from rack.boards.config import resolve
from rack.boards.config.rules import levels
from rack.boards.errors import ConfigError
from tests.boards.conftest import MakeConfig


def test_a_phase_is_less_than_the_period(config: MakeConfig) -> None:
    assert resolve(config("board.watch.phase=7")).layout.task("watch").phase == 7
    with pytest.raises(ConfigError, match="permitted: 0 to 7 ticks"):
        resolve(config("board.watch.phase=8"))


def test_a_segment_may_have_its_largest_size(
    config: MakeConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    layout = resolve(config()).layout
    size = AddressMap(layout).size
    monkeypatch.setattr(levels, "MAX_SEGMENT_BYTES", size)
    assert not [*levels.memory(layout)]
    monkeypatch.setattr(levels, "MAX_SEGMENT_BYTES", size - 1)
    (mistake,) = levels.memory(layout)
    assert f"needs {size} bytes; permitted: {size - 1}" in mistake.why
