"""The workstation of a hand, on a bus of the test: when it plans, what it sends, and what it
draws."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import Message
from rack.backplane.words import Block
from rack.levels.errors import LevelError
from rack.levels.level import LevelContext
from rack.levels.systems.hand.messages import GraspKind
from rack.levels.systems.hand.workstation import Workstation
from tests.levels.arms import cell, config

HAND = cell("utah_mit")
START = HAND.start()
SIZES = {"joints": 16, "fingers": 4, "bodies": 1, "state": 1}
CYCLES = 17


class Crate:
    """A bus with one board, whose messages the test sets: ports of `Workstation`. A second passes
    between two looks."""

    tasks = ("coordinator",)
    tick = 12

    def __init__(self) -> None:
        self.messages = {
            port: Message(source.type.dtype(SIZES)) for port, source in Workstation.inputs.items()
        }
        self.sends: list[dict[str, Any]] = []
        self.looks = 20
        world, hand = self.messages["world"], self.messages["hand"]
        world.position, world.quaternion = START.xpos[HAND.bodies], START.xquat[HAND.bodies]
        world.sensed, hand.position = 7, HAND.home

    @property
    def is_over(self) -> bool:
        self.looks -= 1
        return self.looks < 0

    @property
    def time_s(self) -> float:
        return 20.0 - self.looks

    def wait(self, timeout_s: float) -> bool:
        return True

    def read(self, port: str) -> Reading:
        return Reading(self.messages[port], Verdict.OLD)

    def send(self, port: str, **fields: Any) -> bool:
        assert port == "plan"
        self.sends.append(fields)
        return True

    def address(self, name: str) -> int:
        assert name == "coordinator"
        return 4096

    def words(self, address: int, count: int = 1) -> list[int]:
        return [CYCLES if address == 4096 + 8 * Block.CYCLES else 0] * count


def workstation(tmp_path: Path, **params: Any) -> Workstation:
    robot, scene = config("utah_mit")
    table = {
        "object": "can",
        "opposing": "thumb",
        "picture": str(tmp_path / "{rack}" / "hand.svg"),
        "every_s": 1e-6,
    }
    context = LevelContext(
        board="workstation",
        every=1,
        within_cycles=1,
        clock_ns=500_000,
        seed=1,
        robot=robot,
        scene=scene,
        task={},
        sizes=SIZES,
        params={**table, **params},
        rack="lab",
    )
    return Workstation(context)


@pytest.mark.slow
def test_it_plans_once_and_anew_when_the_object_moves_before_it_is_held(tmp_path: Path) -> None:
    crate, host = Crate(), workstation(tmp_path)
    host.run(crate)  # type: ignore[arg-type]
    (plan,) = crate.sends
    assert (plan["object"], plan["sensed"]) == (0, 7)
    assert {key: np.shape(plan[key]) for key in ("contact", "normal", "posture")} == {
        "contact": (4, 3),
        "normal": (4, 3),
        "posture": (16,),
    }
    crate.messages["world"].position[0, 2] += 0.002
    host.plan(crate)  # type: ignore[arg-type]
    assert len(crate.sends) == 1
    crate.messages["world"].position[0, 0] += 0.004
    host.plan(crate)  # type: ignore[arg-type]
    assert len(crate.sends) == 2
    crate.messages["grasp"].kind = GraspKind.HOLD
    crate.messages["world"].position[0, 0] += 0.01
    host.plan(crate)  # type: ignore[arg-type]
    assert len(crate.sends) == 2


def test_it_waits_until_it_knows_object_and_coordinator(tmp_path: Path) -> None:
    crate, host = Crate(), workstation(tmp_path)
    crate.read = lambda port: Reading(crate.messages[port], Verdict.NONE)  # type: ignore[method-assign]
    host.run(crate)  # type: ignore[arg-type]
    assert not crate.sends
    assert not (tmp_path / "lab").exists()


@pytest.mark.slow
def test_the_picture_is_replaced_whole_and_shows_forces_and_the_crates_counts(
    tmp_path: Path,
) -> None:
    crate, host = Crate(), workstation(tmp_path)
    crate.messages["hand"].force[3] = (0.0, 0.0, 4.0)
    host.run(crate)  # type: ignore[arg-type]
    assert [path.name for path in (tmp_path / "lab").iterdir()] == ["hand.svg"]
    text = (tmp_path / "lab" / "hand.svg").read_text()
    ElementTree.fromstring(text)
    for line in (
        "lab, tick 12",
        "thumb: 4.0 N, tendons 0 to 0 N",
        f"coordinator: {CYCLES}, 0, 0",
        "planned: grip",
    ):
        assert line in text


def test_a_prompt_reads_the_counts_of_the_boards(tmp_path: Path) -> None:
    crate = Crate()
    names = workstation(tmp_path).names(crate)  # type: ignore[arg-type]
    assert names["boards"]() == {"coordinator": {"cycles": CYCLES, "missed": 0, "skipped": 0}}


def test_an_object_that_is_not_in_the_scene_is_refused(tmp_path: Path) -> None:
    with pytest.raises(LevelError, match="object = cup: not in the scene; objects: can"):
        workstation(tmp_path, object="cup")
