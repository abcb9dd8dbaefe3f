"""A rack in one process: what a level of one's own is tested with."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rack.boards import LaunchError, OneProcess
from rack.levels.errors import LevelError
from rack.tools.recording.recording import Recording
from tests.shared_runs import small_run


@pytest.mark.thorough
def test_levels_behave_as_in_a_rack_in_lockstep(
    small: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    recording = Recording(small_run(tmp_path_factory))
    with OneProcess.from_file(small) as rack:
        # By pieces, as a test may.
        rack.run(0.3)
        rack.run_ticks(81)
        assert rack.tick == 201
        assert rack.serials
        for name, serial in rack.serials.items():
            (row,) = np.flatnonzero(recording.read_signal(name, "serial") == serial)
            assert rack.newest(name).record[()] == recording.read_rows(name)["message"][row], name


def test_missing_mailboxes_and_messages_are_reported(small: Path) -> None:
    with OneProcess.from_file(small) as rack:
        with pytest.raises(LookupError, match=r"^'lower\.status' is empty at tick -1$"):
            rack.newest("lower.status")
        with pytest.raises(LookupError, match=r"^no mailbox 'lower'; mailboxes: .*lower\.status"):
            rack.newest("lower")


@pytest.mark.parametrize(
    ("config", "overrides", "reason"),
    [
        (
            "small",
            ["protocol.default=interrupt"],
            r"lower\.status.*: a queue, an exchange or inter",
        ),
        ("penn", [], "a host board, which is a process of its own|a queue, an exchange"),
    ],
)
def test_features_that_need_processes_are_refused(
    small: Path, config: str, overrides: list[str], reason: str
) -> None:
    with pytest.raises(LaunchError, match=reason):
        OneProcess.from_file(small if config == "small" else config, overrides)


def test_levels_are_closed_when_one_fails_its_self_test(small: Path, tmp_path: Path) -> None:
    (tmp_path / "own.py").write_text(
        "from rack.levels.errors import LevelError\n"
        "from tests.two_levels import Upper\n"
        "class Failing(Upper):\n"
        "    closed = 0\n"
        "    def self_test(self):\n"
        "        raise LevelError('no encoder')\n"
        "    def close(self):\n"
        "        Failing.closed += 1\n"
    )
    changes = [f'python_path=["{tmp_path}"]', "board.upper.executor=own:Failing"]
    small.write_text(small.read_text().replace("two_levels:", "tests.two_levels:"))
    rack = OneProcess.from_file(small, changes)
    with pytest.raises(LevelError, match="no encoder"), rack:
        pass
    from own import Failing  # type: ignore[import-not-found]

    assert Failing.closed == 1
