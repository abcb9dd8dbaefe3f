"""Comparisons: statistics and ratios, the table, absent contestants, and the order of calls."""

from __future__ import annotations

import json
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from importlib.machinery import ModuleSpec
from itertools import pairwise
from pathlib import Path
from types import ModuleType

import pytest

from rack.tools.console.tables import render_text
from rack.tools.lab.benches.cyclictest import find_missing_cyclictest
from rack.tools.lab.benches.harness import (
    INSTALL_COMMAND,
    Absent,
    Comparison,
    Sample,
    call_interleaved,
    find_missing_package,
)

SAMPLES = (
    Sample("small", "ours", (3.0, 1.0, 2.0), "us"),
    Sample("small", "theirs", (4.0, 4.0, 10.0), "us"),
    Sample("large", "ours", tuple(float(n) for n in range(1, 102)), "us"),
    Sample("large", "theirs", (0.0, 0.0), "us"),
)
BOTH = Comparison("pair", "Two contestants", SAMPLES, {"small": "theirs", "large": "theirs"})


class Hidden:
    """Finder that hides a package as if it were not installed."""

    def __init__(self, package: str) -> None:
        self._package = package

    def find_spec(
        self, name: str, path: Sequence[str] | None = None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        if name.partition(".")[0] == self._package:
            raise ModuleNotFoundError(f"No module named '{name}'")
        return None


def test_a_sample_has_median_p99_best_and_count() -> None:
    small, _, large, _ = SAMPLES
    assert (small.median, small.best, small.count) == (2.0, 1.0, 3)
    assert (large.median, large.p99) == (51.0, 100.0)
    with pytest.raises(ValueError, match="no measurements"):
        Sample("small", "ours", (), "us")


def test_ratios_are_to_the_baseline_of_the_same_case() -> None:
    small, theirs, large, _ = SAMPLES
    assert BOTH.compute_ratio(small) == 0.5
    assert BOTH.compute_ratio(theirs) == 1.0
    assert BOTH.compute_ratio(small, "best") == 0.25
    assert BOTH.compute_ratio(large) is None, "the baseline's median is 0"
    assert Comparison("pair", "", SAMPLES, {"small": "nobody"}).compute_ratio(small) is None
    assert Comparison("pair", "", SAMPLES, {}).compute_ratio(small) is None


def test_the_document_has_every_statistic_and_names_absent_contestants() -> None:
    missing = Absent("cyclictest", "no program 'cyclictest'", "apt-get install rt-tests")
    found = replace(BOTH, absent=(missing,)).to_document()
    assert json.loads(json.dumps(found)) == found
    names = ("case", "who", "unit", "count", "median", "best", "ratio")
    first = found["samples"][0]
    assert [first[name] for name in names] == ["small", "ours", "us", 3, 2.0, 1.0, 0.5]
    assert first["p99"] == pytest.approx(2.98)
    assert first["p99_ratio"] == pytest.approx(2.98 / 9.88)
    assert found["absent"] == [asdict(missing)]


def test_the_table_fits_the_terminal_and_names_absent_contestants() -> None:
    missing = Absent("iceoryx2", "No module named 'iceoryx2'", INSTALL_COMMAND)
    found = Comparison("pair", "Two contestants", SAMPLES, BOTH.baselines, (missing,))
    lines = list(render_text(found.format_blocks()))
    assert lines[0] == "Two contestants"
    assert (
        lines[-1] == "absent: iceoryx2: No module named 'iceoryx2'; to install: " + INSTALL_COMMAND
    )
    assert " ".join(lines[2].split()) == "small ours 3 2 2.98 1 3 us 0.50 0.30"
    assert max(map(len, list(render_text(found.format_blocks(), 50))[1:-1])) <= 50


def test_a_missing_package_or_program_is_absent(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    assert not find_missing_package("JSON", "json")
    monkeypatch.setattr(sys, "meta_path", [Hidden("iceoryx2"), *sys.meta_path])
    monkeypatch.delitem(sys.modules, "iceoryx2", raising=False)
    hidden = Absent("blackboard", "No module named 'iceoryx2'", INSTALL_COMMAND)
    assert find_missing_package("blackboard", "iceoryx2") == (hidden,)
    monkeypatch.setenv("PATH", str(tmp_path))
    missing = Absent("cyclictest", "no program 'cyclictest'", "apt-get install rt-tests")
    assert find_missing_cyclictest() == (missing,)


def test_each_contestant_is_called_once_per_round_in_a_changing_order() -> None:
    order: list[str] = []
    contestants = {name: partial(order.append, name) for name in "abcd"}
    call_interleaved(contestants, 50)
    rounds = [order[at : at + 4] for at in range(0, 200, 4)]
    assert all(sorted(each) == list("abcd") for each in rounds)
    pairs = Counter(pair for each in rounds for pair in pairwise(each))
    assert len(pairs) == 12
    assert max(pairs.values()) < 30
    first = order.copy()
    order.clear()
    call_interleaved(contestants, 50)
    assert order == first, "every run of a bench has the same order"
