"""The reference of all keys: complete, from the models that validate, with units and meanings."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from rack.boards.config import CONFIGS, FAULTS, list_names, load
from rack.boards.config.files import append_faults, assemble
from rack.boards.config.reference import Key, find_tables, list_key_tables
from rack.boards.errors import ConfigError
from tests.boards.conftest import MakeConfig
from tests.reference import PAGE, page

UNITS = {
    "",
    *("s", "ms", "us", "1/s", "Hz", "ticks", "cycles"),
    *("m", "mm", "m/s", "rad", "rad/s", "rad/s2", "rad/s3", "m or rad", "m/s or rad/s"),
    *("N", "N m", "N or N m", "N/m", "N m/rad", "N/m or N m/rad", "N s/m or N m s/rad"),
    *("1/N", "N/(m s)", "kg m2"),
}
DIMENSIONLESS = {
    *("speed", "small_share", "lockstep_load", "max_missed_fraction", "phase"),  # ratios
    *("damping", "braking", "tolerance", "bring_up", "ratio"),
    *("quaternion", "direction", "x", "z"),
    *("probability", "random", "bits", "part", "factor", "joint", "writes", "killed"),  # of faults
    "offset",  # in the unit of the field
    *("lead", "posture", "reserve"),  # of hands: parts and factors
    "for",  # s, or text with its unit
}
WHOLE = (
    *("reads", "planner_reads", "mailbox", "depth", "tables", "arms", "permit", "posture"),
    *("points", "wires", "wrench", "guard", "speed"),
)
"""Keys whose tables hold names of the user's own."""


def reference(config: str | Path) -> dict[str, dict[str, Key]]:
    """Return the keys by table of a config; tables that differ in their kind are put together."""
    found: dict[str, dict[str, Key]] = {}
    for table in list_key_tables(load(config)):
        place = table.heading.partition(" with ")[0].strip("[]").replace("(top of the file)", "")
        found.setdefault(place, {}).update({key.name: key for key in table.keys})
    return found


def used(tables: Mapping[str, Any], at: str = "") -> Iterator[tuple[str, str]]:
    """Yield table and key for everything that plain tables hold."""
    for key, value in tables.items():
        for item in value if isinstance(value, list) else [value]:
            # A class named in parameters declares its own: what it takes is not in the reference.
            is_whole = key in WHOLE or (key == "params" and ".params." in at)
            if isinstance(item, dict) and not is_whole:
                yield from used(item, f"{at}.{key}".lstrip("."))
            else:
                yield at, key


def general(place: str, known: Iterable[str]) -> str:
    """Return the place of a table as the reference has it, with "<name>" for a name of the user's
    own."""

    def fits(pattern: str) -> bool:
        parts, own = pattern.split("."), place.split(".")
        return len(parts) == len(own) and all(
            part in (name, "<name>") for part, name in zip(parts, own, strict=True)
        )

    return next(filter(fits, known), place)


ALIKE = re.compile(r".*three-poses|nasrem-1khz|fig[34].*|crossing|k1607|nist-state-table/direct")
"""Racks whose boards other racks have as well."""
EACH_RACK = [
    pytest.param(name, marks=pytest.mark.thorough if ALIKE.fullmatch(name) else ())
    for name in list_names()
]


@pytest.mark.slow
@pytest.mark.parametrize("name", EACH_RACK)
def test_the_reference_has_every_key_of_every_shipped_config_with_meaning_and_unit(
    name: str,
) -> None:
    known = reference(name)
    tables = assemble(name, (), None).tables
    assert {
        (at, key) for at, key in used(tables) if key not in known.get(general(at, known), {})
    } == set()
    for place, found in known.items():
        for key in found.values():
            assert key.meaning, f"{place}.{key.name}"
            if "number" in key.type and key.name not in DIMENSIONLESS:
                assert key.unit, f"{place}.{key.name}: {key.meaning}"
            assert key.unit in UNITS, f"{place}.{key.name}: {key.meaning}"
            for suffix, unit in (("_ms", "ms"), ("_s", "s"), ("_hz", "Hz")):
                assert not key.name.endswith(suffix) or key.unit == unit


def test_the_reference_has_every_key_of_every_shipped_fault_script() -> None:
    known = reference("nasrem")["fault"]
    scripts = [append_faults({}, name, CONFIGS)["fault"] for name in list_names(FAULTS)]
    assert {key for script in scripts for fault in script for key in fault} <= set(known)


def test_a_users_own_level_is_in_the_reference(small: Path) -> None:
    path = small.with_name("own.toml")
    path.write_text('extends = ["small.toml"]\n[board.upper]\nexecutor = "two_levels:Programmed"\n')
    assert reference(path)["task"]["count"].meaning == "counts to reach, one after the other"
    path.write_text('extends = ["small.toml"]\n[board.upper]\nexecutor = "two_levels:Nobody"\n')
    with pytest.raises(ConfigError, match="has no class 'Nobody'"):
        reference(path)


def test_the_events_of_a_users_own_level_are_in_the_reference(config: MakeConfig) -> None:
    assert not [table for table in list_key_tables(config()) if table.name.endswith(".findings")]
    surf = config("board.wave.executor=wave_levels:Surf")
    (table,) = find_tables("board.wave.findings", surf)
    assert table.heading == "(events of board.wave)"
    assert table.keys == (Key("breaker", "number", "m", "", "", "the wave breaks"),)


def test_an_unknown_table_is_refused_with_the_known_tables() -> None:
    with pytest.raises(LookupError, match=r"no such table; tables: rack, clock, protocol, .*task"):
        find_tables("bord", load("nasrem"))


def test_the_page_of_all_keys_is_up_to_date() -> None:
    assert PAGE.read_text() == page(), "make reference writes it anew"
