"""The Rack: launched, run and ended, and its events."""

from __future__ import annotations

import gc
import mmap
import os
import re
import shutil
import signal
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from rack.backplane.address_map import AddressMap
from rack.backplane.errors import SegmentError
from rack.backplane.lines import UtilityLines
from rack.backplane.process import LATENCY_REQUEST
from rack.backplane.segment import Segment, get_shm_path, list_racks
from rack.backplane.words import Block, Run, System, TaskState
from rack.boards import Rack
from rack.boards.config.resolved import resolve
from rack.boards.events import Event, Outcome
from tests.boards.conftest import PLAIN, MakeConfig
from tests.boards.runs import end_of
from tests.processes import FORKS, RACK, exit_status, forked, named, run_to_end, wait_until

ROOT = Path(__file__).resolve().parents[3]
BOUND_S = 60
SMALL = ("unshare", "--mount", "sh", "-c", 'mount -t tmpfs -o size=$0 tmpfs /dev/shm && exec "$@"')
"""A command in a /dev/shm of its own, of the size that comes next."""
TWO_MAY, FIVE_MAY = 65_521, 65_524
"""Users of nobody else, who may have so many processes: they are counted by user, and tests run
side by side."""
as_root = pytest.mark.skipif(
    os.getuid() != 0 or not shutil.which("setpriv"), reason="needs root and util-linux"
)


def as_user(uid: int) -> tuple[str, ...]:
    """Return a command as a user who may have no more processes than is permitted, and can read the
    interpreter all the same."""
    return "setpriv", f"--reuid={uid}", "--inh-caps=+dac_override", "--ambient-caps=+dac_override"


def run(rack: Rack, seconds: float | None = None) -> Outcome:
    with rack:
        return rack.run(seconds)


def test_a_run_ends_when_its_task_is_done(config: MakeConfig) -> None:
    outcome = run(Rack(config("board.wave.params.done_at=40")))
    # Written at 40, read by the level that ends the run at 48, visible at 56; then half a second to
    # see it at rest.
    assert (outcome.cause, outcome.state, outcome.ticks, outcome.is_success) == (
        "task done",
        "done",
        56 + 200,
        True,
    )


def test_a_task_that_ends_in_error_has_failed_with_its_reason(config: MakeConfig) -> None:
    outcome = run(Rack(config("board.wave.params.done_at=8", "board.wave.params.final=ERROR")))
    assert (outcome.cause, outcome.state, outcome.reason) == ("task failed", "error", "the tide")
    assert not outcome.is_success


@pytest.mark.slow
@pytest.mark.parametrize(("seconds", "ticks"), [(0.0025, 1), (0.5051, 202)])
def test_a_run_of_given_length_ends_at_its_exact_tick(
    config: MakeConfig, seconds: float, ticks: int
) -> None:
    received: list[Event] = []
    rack = Rack(config(), received.append)
    outcome = run(rack, seconds)
    assert (outcome.cause, outcome.ticks) == ("time over", ticks)
    assert received == rack.events
    told = [event.kind for event in received if event.kind not in ("ready", "waiting")]
    assert told == ["launch", "start", "end"]
    assert (received[0].tick, received[-1].tick) == (-1, ticks - 1)
    assert rack.segment.words[System.TICK] == ticks - 1
    assert rack.segment.get_block("wave")[Block.CYCLES] == ticks


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_boards_are_ready_before_the_clock_runs_and_a_stop_from_outside_ends_them(
    config: MakeConfig, mode: str
) -> None:
    settings = (f"clock.mode={mode}", "protocol.default=lock", "clock.idle_cores=awake")
    with Rack(config(*settings), share=True) as rack:
        # Ready before the clock runs, and only the segment has a name.
        tasks = [rack.segment.get_block(task.name) for task in rack.segment.layout.tasks]
        words = rack.segment.words
        assert (words[System.STATE], words[System.TICK]) == (Run.STARTING, 0)
        assert words[System.EMERGENCY_STOP] == 1
        assert UtilityLines(rack.segment).sysfail == []
        assert all(TaskState.READY <= task[Block.STATE] <= TaskState.RUNNING for task in tasks)
        own = get_shm_path(rack.config.name)
        assert [p for p in own.parent.iterdir() if rack.config.name in p.name] == [own]
        rack.start()
        wait_until(lambda: rack.watch(0.01) and words[System.TICK] > 2)
        assert words[System.EMERGENCY_STOP] == 0
        # In real time the clock, and no other process, holds idle cores awake.
        holding = mode == "realtime" and os.access(LATENCY_REQUEST, os.W_OK)
        opened = {
            pid: [one.readlink() for one in Path(f"/proc/{pid}/fd").iterdir()]
            for pid in named(f"{rack.config.name}:")
        }
        holders = [pid for pid, files in opened.items() if LATENCY_REQUEST in files]
        assert holders == [words[System.CLOCK_PID]] * holding
        Segment.attach(rack.config.name).words[System.STOP_REQUEST] = 1
        outcome = end_of(rack)
    assert (outcome.cause, outcome.is_success) == ("stopped", False)
    assert {task[Block.STATE] for task in tasks} == {TaskState.ENDED}
    assert rack.config.name not in list_racks()


@pytest.mark.slow
def test_a_running_racks_name_is_refused_and_the_rack_continues(config: MakeConfig) -> None:
    with Rack(config("clock.mode=realtime")) as first:
        first.start(0.25)
        with pytest.raises(
            SegmentError,
            match=f"rack '{first.config.name}' is already running, launched by process",
        ):
            Rack(config()).launch()
        assert end_of(first).cause == "time over"


@pytest.mark.slow
def test_a_removed_rack_frees_its_memory(config: MakeConfig) -> None:
    rack = Rack(config())
    run(rack, 0.0025)
    name = get_shm_path(rack.config.name).name
    maps = Path("/proc/self/maps")
    # Unlinked but still mapped, so the counters of an ended run remain readable.
    assert rack.segment.get_block("wave")[Block.CYCLES] == 1
    before = maps.read_text().count("(deleted)")
    del rack
    gc.collect()
    assert maps.read_text().count("(deleted)") < before, name


@pytest.mark.slow
@as_root
@pytest.mark.parametrize(
    ("limits", "why"),
    [
        (
            ("prlimit", "--nofile=8"),
            r"Too many open files: the limit is 8 open files \(ulimit -n\)",
        ),
        (
            ("prlimit", "--nofile=20"),
            r"rack '.*': at most 20 open files are permitted \(ulimit -n\); the rack needs 3\d",
        ),
        (
            ("prlimit", "--nproc=2", *as_user(TWO_MAY)),
            r"board 'wave' cannot be forked: Resource .* the limit is 2 processes .*;"
            r" the rack needs 6",
        ),
        (
            (*SMALL, "half"),
            r"rack '.*': \d+ bytes of shared memory: No space left .*: /dev/shm has \d+ bytes,"
            r" \d+ of .*",
        ),
    ],
)
def test_a_limit_of_the_system_is_one_line_with_its_value(
    config: MakeConfig, tmp_path: Path, limits: tuple[str, ...], why: str
) -> None:
    plain = config(text=PLAIN)
    size = AddressMap(resolve(plain).layout).size
    sizes = {"half": str(size // mmap.PAGESIZE // 2 * mmap.PAGESIZE)}
    path = tmp_path / "limited.toml"
    path.write_text(plain.to_toml_text())
    command = [*(sizes.get(word, word) for word in limits), *RACK, "run", str(path)]
    done = run_to_end([*command, "--seconds", "0.1", "--no-record", "--share"], BOUND_S, cwd=ROOT)
    assert done.returncode == 1
    # Racks of other tests may run beside it: it names them, and what it waits for.
    said = [line for line in done.stderr.splitlines() if not line.startswith("waiting: ")]
    assert re.fullmatch(why, "\n".join(said))
    assert done.stdout == ""


@pytest.mark.thorough
@as_root
@pytest.mark.filterwarnings(FORKS)
def test_a_restart_that_the_system_refuses_is_reported_and_ends_the_run_properly(
    config: MakeConfig, tmp_path: Path, rack_name: str
) -> None:
    path, out = tmp_path / "limited.toml", tmp_path / "out"
    path.write_text(config("clock.mode=realtime", text=PLAIN).to_toml_text())
    limits = ("prlimit", "--nproc=5", *as_user(FIVE_MAY))

    def run_long() -> None:
        command = [*limits, *RACK, "run", str(path), "--seconds", "60", "--no-record", "--share"]
        done = run_to_end(command, BOUND_S, cwd=ROOT)
        out.write_text(f"{done.returncode} {done.stderr}")

    def occupy() -> None:
        os.setuid(FIVE_MAY)
        time.sleep(BOUND_S)

    def is_full() -> bool:
        assert not out.exists(), out.read_text()
        count = 0
        for status in Path("/proc").glob("[0-9]*/status"):
            with suppress(OSError):
                count += f"\nUid:\t{FIVE_MAY}\t" in status.read_text()
        return count >= 8

    with ExitStack() as stack:
        runner = stack.enter_context(forked(run_long))
        # A whole command: on a loaded machine its imports alone may take half a minute.
        wait_until(lambda: rack_name in list_racks(), BOUND_S)
        segment = Segment.attach(rack_name)
        stack.callback(segment.close)
        # Before the clock runs, a board that cannot be forked is a launch that fails.
        wait_until(lambda: segment.words[System.TICK] > 0, BOUND_S)
        # More than the board that dies leaves room for.
        for _ in range(3):
            stack.enter_context(forked(occupy))
        wait_until(is_full)
        os.kill(named(f"{rack_name}:wave")[0], signal.SIGKILL)
        assert exit_status(runner, BOUND_S) == 0
    assert out.read_text().startswith("1 ")
    # The kernel keeps only the first letters of either name.
    assert re.search(
        "printed: board '(wave|watch)' cannot be forked: Resource temp", out.read_text()
    )
