"""Settings that a level takes over, and state that it keeps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rack.backplane.message import Status
from rack.boards.run.settings import change_settings
from rack.levels.level import Executor, LevelContext, Output
from rack.levels.tables import Table
from tests.levels.arms import config


class Gains(Table):
    gain: float = 1.0
    other: float = 5.0


class Filter:
    def __init__(self, gain: float) -> None:
        self.gain = gain
        self.seen = 0


class Gauge(Executor):
    status = Output(Status)
    params = Gains
    settings: Gains

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        gain = self.settings.gain
        self.gain = gain
        self.table = np.array([gain, 2.0])
        self.filter = Filter(gain)
        self.by_name = {"gain": gain, "kept": 0.0}
        self.reference = None if gain == 1.0 else Filter(gain)

    def process(self, tick: int) -> None:
        self.filter.seen += 1


@pytest.fixture
def level() -> Gauge:
    robot, scene = config("utah_mit")
    params = {"gain": 1.0}
    return Gauge(LevelContext("gauge", 1, 1, 2_500_000, 0, robot, scene, {}, {}, params=params))


def changed(level: Gauge, gain: float) -> None:
    change_settings(level, replace(level.context, params={"gain": gain}))


def test_new_settings_take_effect_and_the_state_is_kept(level: Gauge) -> None:
    level.process(0)
    level.by_name["kept"] = 3.0
    changed(level, 4.0)
    assert (level.gain, level.filter.gain, level.filter.seen) == (4.0, 4.0, 1)
    assert level.table.tolist() == [4.0, 2.0]
    assert level.by_name == {"gain": 4.0, "kept": 3.0}
    assert level.context.params == {"gain": 4.0}


def test_attributes_that_the_level_has_changed_are_kept(level: Gauge) -> None:
    level.gain = 7.0
    level.table[0] = 9.0
    changed(level, 4.0)
    assert (level.gain, level.table[0]) == (7.0, 9.0)
    assert level.filter.gain == 4.0


def test_none_becomes_an_object_unless_the_level_has_created_one(level: Gauge) -> None:
    changed(level, 4.0)
    assert isinstance(level.reference, Filter)
    own = level.reference = Filter(8.0)
    changed(level, 1.0)
    assert level.reference is own
