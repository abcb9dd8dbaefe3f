"""Equal digests on every machine: those of the shipped racks stand in golden.toml."""

from __future__ import annotations

import pytest

from tests import golden


@pytest.fixture(scope="module")
def known() -> dict[str, dict[str, str]]:
    return golden.read()


def test_every_run_has_a_golden_digest_and_none_is_left_over(
    known: dict[str, dict[str, str]],
) -> None:
    assert set(known["digests"]) == set(golden.RUNS)


@pytest.mark.slow
@pytest.mark.parametrize(
    "run",
    [
        pytest.param(run, marks=() if run in golden.OFTEN else pytest.mark.thorough)
        for run in golden.RUNS
        # Snapshots of the others are continued to the same digests in test_random_ticks.py.
        if run in golden.OFTEN or run not in golden.CONTINUED
    ],
)
def test_a_shipped_rack_has_its_golden_digest(
    run: str, rack_name: str, known: dict[str, dict[str, str]]
) -> None:
    here = golden.machine()
    others = {
        name: (there, here[name]) for name, there in known["machine"].items() if here[name] != there
    }
    if "libm" in others:
        pytest.skip(
            "the C library here rounds sin, exp, ... otherwise than that of the golden digests"
        )
    expected = known["digests"].get(run)
    assert golden.digest(run, rack_name) == expected, (
        f"the rack does otherwise than it did: {others or ''} make golden"
    )
