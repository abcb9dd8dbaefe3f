"""`rack check` of configs that somebody has spoilt: whatever stands in them, it ends in time with 0, 1 or 2.

1 means one thing alone: the config is sound, and its timing does not fit. Anything else is a mistake, a line each.
"""

from __future__ import annotations

import copy
import json
import os
import signal
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from boards.config import CONFIGS, load, names
from boards.config.text import to_toml
from tools.answer import LONGEST_LINE
from tools.cli import main

EXAMPLES = int(os.environ.get("RACK_CHECK_EXAMPLES", "150"))
BOUND_S = 20
"""Processor time of one check, at most: the machine's load does not count."""

DEEP: list[Any] = []
for _ in range(40):
    DEEP = [DEEP]
PLAIN = (True, False, 0, 1, -1, 3, 99, 2**31, 2**63 - 1, 2**70, 0.0, 0.5, 2.5, 1e-9, 1e9, 5e-324, 1e300, -1e300)
ODD = (
    float("inf"),
    float("-inf"),
    float("nan"),
    "",
    "lock",
    "servo",
    "x" * 5000,
    "two\nlines",
    "a\0b",
    "../..",
    "~no/x",
)
LISTS = ([], [1], [1.0] * 6, ["a"], [[]], [0] * 1000, {}, {"a": 1}, {"": {}}, {"every": 8}, DEEP)
VALUES = (*PLAIN, *ODD, *LISTS)
KEYS = ("", "x", "every", "rate_hz", "below", "planner", "params", "a.b", "two\nlines", "k" * 300, "model")


def texts() -> dict[str, dict[str, Any]]:
    """Every config that is shipped, by itself and resolved, and what is no rack by itself over one that is."""
    found = {
        str(path.relative_to(CONFIGS)): tomllib.loads(path.read_text()) for path in sorted(CONFIGS.rglob("*.toml"))
    }
    for place, tables in found.items():
        if "robot" in tables:
            tables["robot"]["model"] = f"robots/{tables['robot']['model']}"
        if "/" in place:
            tables["extends"] = ["nasrem"]
    return found | {f"{name}, resolved": tomllib.loads(load(name).text()) for name in names()}


TEXTS = texts()


def paths(node: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the way to every value."""
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in items:
        yield (*path, key)
        yield from paths(value, (*path, key))


def at(node: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        node = node[key]
    return node


@st.composite
def spoilt(draw: st.DrawFn) -> str:
    """Draw the text of a config with one to three changes that a user, or somebody worse, might make."""
    tables = copy.deepcopy(TEXTS[draw(st.sampled_from(sorted(TEXTS)))])
    for _ in range(draw(st.integers(1, 3))):
        ways = list(paths(tables))
        *way, key = draw(st.sampled_from(ways))
        holder = at(tables, tuple(way))
        change = draw(st.sampled_from(("replace", "replace", "swap", "delete", "rename", "add", "double")))
        if change == "delete":
            del holder[key]
        elif change == "rename" and isinstance(holder, dict):
            holder[draw(st.sampled_from(KEYS))] = holder.pop(key)
        elif change == "add" and isinstance(holder, dict):
            holder[draw(st.sampled_from(KEYS))] = copy.deepcopy(draw(st.sampled_from(VALUES)))
        elif change == "double":
            twin = copy.deepcopy(holder[key])
            holder.append(twin) if isinstance(holder, list) else holder.update({f"{key}2": twin})
        elif change == "swap":
            holder[key] = copy.deepcopy(at(tables, draw(st.sampled_from(ways))))
        else:
            holder[key] = copy.deepcopy(draw(st.sampled_from(VALUES)))
        if not tables:
            break
    return to_toml(tables)


@contextmanager
def bounded() -> Iterator[None]:
    """Let the body have so much processor time, and no more."""

    def end(signum: int, frame: object) -> None:
        raise TimeoutError(f"more than {BOUND_S} s of processor time")

    before = signal.signal(signal.SIGPROF, end)
    signal.setitimer(signal.ITIMER_PROF, BOUND_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def no_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON")


def check(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, dict[str, Any]]:
    """Return the status of `rack check --json`, in this process, and its answer."""
    capsys.readouterr()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", ["rack", "check", *arguments, "--json"])
        with bounded(), pytest.raises(SystemExit) as ended:
            main()
    document = json.loads(capsys.readouterr().out, parse_constant=no_constant)
    return int(ended.value.code or 0), document


def judge(status: int, document: dict[str, Any]) -> None:
    if status == 2:
        assert document["error"]
        assert all(line and line.isprintable() and len(line) <= LONGEST_LINE for line in document["error"])
    else:
        assert status == (0 if document["timing"]["holds"] else 1)


@settings(
    max_examples=EXAMPLES,
    derandomize="RACK_CHECK_EXAMPLES" not in os.environ,
    database=None,
    deadline=None,
    phases=(Phase.generate,),
    suppress_health_check=list(HealthCheck),
)
@given(text=spoilt())
def test_a_spoilt_config_is_answered_in_time_with_what_is_wrong(
    text: str, tmp_path_factory: pytest.TempPathFactory, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path_factory.getbasetemp() / "spoilt.toml"
    path.write_text(text)
    judge(*check(capsys, str(path)))
