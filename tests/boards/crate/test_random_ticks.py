"""From random ticks a rack goes on to its own digest: in the middle of motions, plans, faults,
restarts and holds; and so does every shipped rack."""

from __future__ import annotations

import random
import shlex
from pathlib import Path

import pytest

from rack.boards import Rack
from rack.boards.config import load
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import WarmCrate
from rack.boards.wiring import Continuation, SnapshotPolicy
from rack.tools.lab.benches.observed import record_rack
from rack.tools.launch.continued import RepeatedRun
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display
from rack.tools.recording.recording import Recording
from tests import golden
from tests.conftest import EXHAUSTIVE

pytestmark = pytest.mark.thorough
SEED = 43
SECONDS = 7.0
COUNT = 25 if EXHAUSTIVE else 1
"""Random ticks of each of the four NASREM runs."""
TASK_S = 23.5
"""Time of the whole task of `k1607`, the only one of these runs that goes to its end."""
HOLDS = (
    "command=[{ level = 'task', what = 'hold', at = 2.0 }, { level = 'task', what = 'resume', at ="
    " 3.0 }, { level = 'servo', what = 'hold', at = 4.5 }, { level = 'servo', what = 'resume', at ="
    " 5.2 }]"
)
RUNS = {
    "plain": ((), None, SECONDS, COUNT),
    "restarts": ((), "kill-each-board", SECONDS, COUNT),
    "faults": ((), "bad-sensors", SECONDS, COUNT),
    "holds": ((HOLDS,), None, SECONDS, COUNT),
    "restarts and holds": ((HOLDS,), "kill-each-board", 4.0, 2),
}
HOSTED_S = 3.0
OF_SHIPPED = 10 if EXHAUSTIVE else 1
"""Random ticks of each run of the other racks."""
SHIPPED = golden.RUNS if EXHAUSTIVE else golden.CONTINUED


def strays(config: RackConfig, seconds: float | None, count: int, expected: str = "") -> list[int]:
    """Return those of `count` random ticks from which a rack does not go on to the expected digest,
    by default that of a run without snapshots."""
    length = round(1e3 * (seconds or TASK_S) / config.clock.period_ms)
    ticks = random.Random(SEED).sample(range(length), min(count, length))
    found = []
    with WarmCrate() as crate:
        if not expected:
            with Rack(config, crate=crate) as plain:
                expected = plain.run(seconds).digest
        losses = None
        for nth, tick in enumerate(ticks):
            wanted = SnapshotPolicy(part=10, at=tick)
            known = (len(config.fault), len(config.command), losses or ())
            begins = Continuation(tick, *known) if min(ticks[:nth], default=tick) < tick else None
            # It has a snapshot there, and goes on to its end.
            with Rack(config, crate=crate, snapshots=wanted, continues=begins) as rack:
                outcome = rack.run(seconds)
                if losses is None:
                    died = (event for event in rack.events if event.kind == "died")
                    losses = tuple((event.board, event.tick) for event in died)
            if outcome.digest != expected:
                found.append(tick)
            begins = Continuation(tick, *known[:2], losses)
            with Rack(config, crate=crate, continues=begins) as rack:
                again = rack.run(seconds)
            if (again.digest, again.ticks) != (expected, outcome.ticks):
                found.append(tick)
    return found


@pytest.mark.timeout(900)
@pytest.mark.parametrize("run", RUNS)
def test_nasrem_continues_from_random_ticks(run: str, rack_name: str) -> None:
    settings, faults, seconds, count = RUNS[run]
    config = load("nasrem", [f"name={rack_name}", "clock.mode=lockstep", *settings], faults)
    assert strays(config, seconds, count) == []


def rack_of(run: str, name: str) -> tuple[RackConfig, float | None]:
    """Return the config of a golden run, as the rack `name`, and how long it lasts."""
    words = shlex.split(run)
    options = dict(zip(words[1::2], words[2::2], strict=True))
    place = golden.FILE.parents[1] / words[0]
    settings = [f"name={name}", "clock.mode=lockstep", *options.get("--set", "").split()]
    found = place if place.is_file() else words[0]
    seconds = options.get("--seconds")
    config = load(found, settings, options.get("--faults"))
    return config, None if seconds is None else float(seconds)


@pytest.mark.timeout(900)
@pytest.mark.parametrize("run", [run for run in SHIPPED if not run.startswith(golden.HOSTED)])
def test_a_shipped_rack_continues_from_random_ticks(run: str, rack_name: str) -> None:
    config, seconds = rack_of(run, rack_name)
    assert strays(config, seconds, OF_SHIPPED, golden.read()["digests"][run]) == []


@pytest.mark.timeout(480)
@pytest.mark.parametrize("system", golden.HOSTED)
def test_a_shipped_rack_with_host_programs_continues_with_their_recorded_messages(
    system: str, rack_name: str, tmp_path: Path
) -> None:
    config, _ = rack_of(system, rack_name)
    one = record_rack(config, HOSTED_S, tmp_path / "one")
    ends = one.result.outcome
    with RepeatedRun(Recording(tmp_path / "one")) as again:
        for tick in random.Random(SEED).sample(range(ends.ticks), OF_SHIPPED):
            folder = tmp_path / str(tick)
            result = run_rack(
                config, HOSTED_S, folder, Display(), beginning=again.continue_at(tick)
            )
            assert result.outcome.digest == ends.digest, tick
