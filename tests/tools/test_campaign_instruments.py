"""A campaign that says "no limit violated" has made sure that it would say so if one were."""

from __future__ import annotations

import pytest

from rack.boards.config import load
from rack.levels.arm.limit_monitor import LimitMonitor
from rack.tools.answer import Failure
from rack.tools.campaigns.environment import examine


def test_a_counter_of_violations_that_counts_passes() -> None:
    examine(load("nasrem"))


def test_a_counter_of_violations_that_does_not_count_ends_the_campaign(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(LimitMonitor, "_count", lambda monitor, *_: None)
    with pytest.raises(Failure, match=r"violation counter: joint 'j1' at \d+.* rad/s, twice its limit, is not counted"):
        examine(load("nasrem"))


def test_a_rack_without_an_arm_has_no_limits_to_violate() -> None:
    examine(load("fig4"))
