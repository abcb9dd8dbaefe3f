"""Workers make trials in processes of their own, and end with the campaign."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from multiprocessing import active_children
from pathlib import Path

import pytest

from rack.backplane.process import is_alive
from rack.boards.config import RackConfig
from rack.tools.console.answer import Failure
from rack.tools.console.interrupt import INTERRUPT, list_descendants
from rack.tools.faults.campaigns.plan import Plan
from rack.tools.faults.campaigns.workers import TrialJob, Workers
from tests.processes import FORKS, forked, wait_until

pytestmark = pytest.mark.slow
SECONDS = 0.2
BOUND_S = 30.0


def job(folder: Path, number: int, **more: object) -> TrialJob:
    plan = Plan(number, "faultless", lockstep=True, **more)  # type: ignore[arg-type]
    return TrialJob(plan, folder / f"{number}.json", ticks=0, seconds=SECONDS)


def test_each_trial_leaves_a_file_and_no_process_stays(config: RackConfig, tmp_path: Path) -> None:
    jobs = [job(tmp_path, number) for number in range(4)]
    with Workers(config) as workers:
        done = list(workers.run(jobs, alone=False))
        processes = {process.pid for process in active_children()}
        assert 1 <= len(processes) <= len(os.sched_getaffinity(0))
        # The same processes make later trials.
        done += list(workers.run([job(tmp_path, 4)], alone=True))
        assert {process.pid for process in active_children()} == processes
    assert sorted(one.plan.number for one in done) == [0, 1, 2, 3, 4]
    assert all(one.path.is_file() for one in done)
    assert not active_children()


@pytest.mark.thorough
@pytest.mark.filterwarnings(FORKS)
def test_workers_end_with_a_campaign_that_is_killed(config: RackConfig, tmp_path: Path) -> None:
    endless = replace(job(tmp_path, 5), seconds=1e6)

    def campaign() -> None:
        with Workers(config) as workers:
            list(workers.run([endless], alone=False))

    with forked(campaign) as pid:
        # A worker, its crate, and a board at least.
        wait_until(lambda: len([*list_descendants(pid)]) > 3)
        family = [*list_descendants(pid)]
        os.kill(pid, signal.SIGKILL)
        wait_until(lambda: not any(map(is_alive, family)))


@pytest.mark.thorough
def test_a_trial_that_cannot_be_made_ends_the_campaign_with_its_reason(
    config: RackConfig, tmp_path: Path
) -> None:
    bad = job(tmp_path, 7, faults=({"kind": "hang", "board": "nobody", "tick": 3},))
    with (
        Workers(config) as workers,
        pytest.raises(Failure, match=r"^trial 7 failed: ConfigError: .*nobody"),
    ):
        list(workers.run([bad], alone=False))


@pytest.mark.thorough
def test_a_worker_that_was_killed_ends_the_campaign_with_its_reason(
    config: RackConfig, tmp_path: Path
) -> None:
    with Workers(config) as workers:
        list(workers.run([job(tmp_path, 8)], alone=False))
        for worker in active_children():
            worker.kill()
            worker.join(BOUND_S)
        with pytest.raises(Failure, match=r"^trial 9 failed: its worker process has ended"):
            list(workers.run([job(tmp_path, 9)], alone=True))


def test_no_trial_begins_after_a_signal(
    config: RackConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(INTERRUPT, "number", 2)
    with Workers(config) as workers:
        assert list(workers.run([job(tmp_path, 8)], alone=True)) == []
    assert list(tmp_path.glob("*.json")) == []
