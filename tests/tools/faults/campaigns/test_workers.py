"""Workers make trials in processes of their own, and end with the campaign."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from rack.boards.config import RackConfig, load
from rack.tools.console.answer import Failure
from rack.tools.faults.campaigns.plan import Plan
from rack.tools.faults.campaigns.workers import TrialJob, Workers

pytestmark = pytest.mark.slow
SECONDS = 0.2


@pytest.fixture
def config(small: Path) -> RackConfig:
    return load(small)


def job(folder: Path, number: int, **more: object) -> TrialJob:
    plan = Plan(number, "faultless", lockstep=True, **more)  # type: ignore[arg-type]
    return TrialJob(plan, folder / f"{number}.json", ticks=0, seconds=SECONDS)


def test_each_trial_leaves_a_file_and_no_process_stays(config: RackConfig, tmp_path: Path) -> None:
    jobs = [job(tmp_path, number) for number in range(3)]
    with Workers(config) as workers:
        done = list(workers.run(jobs, alone=False))
        processes = list(workers._processes)
        assert 1 <= len(processes) <= len(workers._cores)
        # Each has a core of its own.
        cores = [os.sched_getaffinity(process.pid) for process in processes]
        assert cores == [{core} for core in workers._cores[: len(processes)]]
        # The same processes make later trials.
        done += list(workers.run([job(tmp_path, 3)], alone=True))
        assert workers._processes == processes
    assert sorted(one.plan.number for one in done) == [0, 1, 2, 3]
    assert all(one.path.is_file() for one in done)
    assert [process.returncode is not None for process in processes] == [True] * len(processes)


def test_a_trial_that_cannot_be_made_ends_the_campaign_with_its_reason(
    config: RackConfig, tmp_path: Path
) -> None:
    bad = job(tmp_path, 7, faults=({"kind": "hang", "board": "nobody", "tick": 3},))
    with (
        Workers(config) as workers,
        pytest.raises(Failure, match=r"^trial 7: ConfigError: .*nobody"),
    ):
        list(workers.run([bad], alone=False))
