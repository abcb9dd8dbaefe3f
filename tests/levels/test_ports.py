"""Ports of a level, as attributes: what a class declares, and what an object finds in them."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from rack.backplane.mailbox.mailbox import Reading, Verdict
from rack.backplane.message import Message, field
from rack.levels.errors import LevelError
from rack.levels.level import Executor, Input, Inputs, LevelContext, Output, QueuedOutput

CONTEXT = cast(LevelContext, SimpleNamespace(sizes={}))


class Number(Message, version=1):
    """A number."""

    value: int = field(unit="1", doc="")


class Base(Executor):
    """Reads two ports, writes one."""

    above = Input(Number, "above.number")
    below = Inputs(Number, "below.number", optional=True)
    number = Output(Number, rests_on=above)

    def process(self, tick: int) -> None:
        """Hand the number on."""
        self.number.value = self.above.message.value


def test_a_class_has_the_ports_of_its_bases_then_its_own() -> None:
    class Derived(Base):
        below = None  # type: ignore[assignment]
        more = Input(Number, "own.number")
        last = QueuedOutput(Number)

    assert [*Base.inputs] == ["above", "below"]
    assert [*Derived.inputs] == ["above", "more"]
    assert [*Derived.outputs] == ["number", "last"]
    assert Derived.outputs["number"].rests_on is Base.above
    assert (Derived.last.queued, Base.below.many, Base.below.optional) == (True, True, True)


def test_a_level_without_a_board_has_empty_readings_and_messages() -> None:
    level = Base(CONTEXT)
    assert (level.above.verdict, level.above.message.value, level.below) == (Verdict.NONE, 0, {})
    number = Number.zeros({})
    number.value = 5
    level.find_input_table("above")["above"] = Reading(number, Verdict.NEW)
    level.process(0)
    assert level.number.value == 5
    assert Base(CONTEXT).number.value == 0


@pytest.mark.parametrize(
    ("body", "why"),
    [
        ({"context": Input(Number, "a.b")}, ""),
        ({"inputs": {"a": Input(Number, "a.b")}}, "'inputs' is no longer a dict"),
        ({"process": Input(Number, "a.b")}, "port 'process' has the name of another attribute"),
        ({"params": Output(Number)}, "port 'params' has the name of another attribute"),
        ({"above": 3}, "attribute 'above' has the name of a port"),
        ({"number": lambda self: None}, "attribute 'number' has the name of a port"),
    ],
)
def test_a_port_with_the_name_of_another_attribute_is_an_error_of_the_class(
    body: dict[str, Any], why: str
) -> None:
    if not why:
        # The constructor sets it: that is found when a board connects the port.
        level = type("Bad", (Base,), body)(CONTEXT)
        with pytest.raises(LevelError, match="class Bad: attribute 'context' has the name of a"):
            level.find_input_table("context")
        return
    with pytest.raises(LevelError, match=f"^class Bad: {why}"):
        type("Bad", (Base,), body)


def test_ports_from_a_config_are_separate_from_attributes() -> None:
    level = Base(CONTEXT)
    level.find_input_table("context")["context"] = 1
    level.store_output("process", 2)
    assert level.ports == {"context": 1, "process": 2}
    assert level.context is CONTEXT


def test_an_unconnected_level_cannot_send() -> None:
    class Sending(Base):
        letters = QueuedOutput(Number)

    with pytest.raises(LevelError, match="port 'letters': no board has connected it"):
        _ = Sending(CONTEXT).letters
