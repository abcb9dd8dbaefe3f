"""Tests the rule for names of racks, and the names derived by it."""

from __future__ import annotations

import pytest
from pydantic import TypeAdapter, ValidationError

from rack.boards.config.schema import RackName
from rack.tools.commands.robot import derive_name, is_free_name

TAKEN = ("nasrem",)
DERIVED = {
    "SixArm": "sixarm",
    "_arm": "arm",
    "arm-": "arm",
    "6 dof arm v2.0": "6-dof-arm-v2-0",
    "Roboterarm Größe Ä": "roboterarm-groe-a",
    "机器人": "arm",
    "": "arm",
    "..": "arm",
    "nasrem": "nasrem-arm",
    "a" * 41: "a" * 40,
    "a" * 39 + " b": "a" * 39,
    "left_arm": "left_arm",
}


@pytest.mark.parametrize("text", DERIVED)
def test_a_name_made_of_any_text_is_one_that_configs_accept(text: str) -> None:
    name = derive_name(text, TAKEN)
    assert name == DERIVED[text]
    assert is_free_name(name, TAKEN)
    assert TypeAdapter(RackName).validate_python(name) == name


@pytest.mark.parametrize("name", ["SixArm", "_arm", "-x", "a b", "a/b", "", "ä", "a\n", "a" * 41])
def test_a_name_that_configs_refuse_is_not_free(name: str) -> None:
    assert not is_free_name(name, TAKEN)
    with pytest.raises(ValidationError):
        TypeAdapter(RackName).validate_python(name)


def test_a_name_that_is_taken_is_not_free() -> None:
    assert not is_free_name("nasrem", TAKEN)
