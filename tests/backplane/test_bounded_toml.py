"""TOML from outside: parsed as by the library, and no text takes long to parse."""

from __future__ import annotations

import tomllib
from contextlib import suppress

import pytest

from rack.backplane.bounded_toml import MAX_DEPTH, TOO_DEEP, TOO_LONG, load_toml

DEEP = ".".join("a" * 200_000)
DEEP_KEYS = {
    "a key": f"{DEEP} = 1",
    "a header": f"[{DEEP}]",
    "the header of a list": f"[[{DEEP}]]",
    "quoted parts": ".".join(['"a.b"'] * 200_000) + " = 1",
    "spaces around the dots": " . ".join("a" * 200_000) + " = 1",
    "an inline table": f"x = {{{DEEP} = 1}}",
    "after a comment": f'# it\'s """\n{DEEP} = 1',
    "after five quotes": f'x = {{y = """a"""""", {DEEP} = 1}}'.replace('""""""', '"""""'),
    "after an escaped quote": f'x = {{y = "\\"", {DEEP} = 1}}',
    "after literal text": f"x = {{y = 'a\\', z = '''b''''', {DEEP} = 1}}",
}


@pytest.mark.parametrize("text", DEEP_KEYS.values(), ids=DEEP_KEYS)
def test_a_key_of_very_many_parts_is_refused_at_once(text: str) -> None:
    with pytest.raises(ValueError, match=TOO_DEEP):
        load_toml(text)


@pytest.mark.parametrize(
    "text",
    [
        f'x = "{DEEP}"',
        f"x = '{DEEP}' # {DEEP}",
        f'x = """\n{DEEP}\\""" ""\n"""""\ny = 1',
        f"x = '''\n{DEEP}'' '\n'''''",
        f'"{DEEP}" = 1',
        ".".join("a" * MAX_DEPTH) + " = 1",
        f"x = [{', '.join(['1.5'] * 100)}]",
        "\n".join(["[[x.y]]\na.b = 1.5e-3"] * 100),
        "x = 1979-05-27T07:32:00.999999",
    ],
)
def test_text_without_deep_keys_is_parsed_as_by_the_library(text: str) -> None:
    assert load_toml(text) == tomllib.loads(text)


@pytest.mark.parametrize(
    "piece", ['"\\', "'''", '"""\\', '"', "''", "# '", '"""a', "a.", "a . ", "\\", "=", "[", "{a="]
)
def test_the_time_for_any_text_grows_with_its_length_alone(piece: str) -> None:
    with suppress(ValueError):
        load_toml(piece * (1_000_000 // len(piece)))


def test_deep_lists_and_long_integers_are_refused_with_their_reason() -> None:
    with pytest.raises(ValueError, match=TOO_DEEP):
        load_toml(f"x = {'[' * 10_000}")
    with pytest.raises(ValueError, match=TOO_LONG):
        load_toml(f"x = {'9' * 10_000}")
