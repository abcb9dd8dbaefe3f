"""The Rack: launched, run and ended, and its events."""

from __future__ import annotations

import gc
import mmap
import os
import re
import shutil
import signal
import subprocess
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from rack.backplane.errors import SegmentError
from rack.backplane.lines import UtilityLines
from rack.backplane.segment import Segment, racks, shm_path, unlink
from rack.backplane.words import Block, Run, System, TaskState
from rack.boards import Rack
from rack.boards.config.resolved import resolve
from rack.boards.config.schema import RackConfig
from rack.boards.events import Event, Outcome
from tests.boards.conftest import PLAIN, MakeConfig
from tests.machine import needs_fifo
from tests.processes import (
    FORKS,
    RACK,
    descriptors,
    exit_status,
    forked,
    named,
    parent_of,
    wait_until,
)

ROOT = Path(__file__).resolve().parents[3]
BOUND_S = 60
SMALL = ("unshare", "--mount", "sh", "-c", 'mount -t tmpfs -o size=$0 tmpfs /dev/shm && exec "$@"')
"""A command in a /dev/shm of its own, of the size that comes next."""
ONE_MAY, TWO_MAY, FOUR_MAY, FIVE_MAY = range(65_521, 65_525)
"""Users of nobody else: processes are counted by user, and tests run side by side."""
PLAIN_ROOT = ("setpriv", "--bounding-set=-sys_nice,-ipc_lock", "--inh-caps=-sys_nice,-ipc_lock")
"""A command without the rights to real-time priorities and to locked memory."""
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
    assert (outcome.cause, outcome.state, outcome.ticks, outcome.worked) == (
        "task done",
        "done",
        56 + 200,
        True,
    )


def test_a_task_that_ends_in_error_has_failed_with_its_reason(config: MakeConfig) -> None:
    outcome = run(Rack(config("board.wave.params.done_at=8", "board.wave.params.final=ERROR")))
    assert (outcome.cause, outcome.state, outcome.reason) == ("task failed", "error", "the tide")
    assert not outcome.worked


@pytest.mark.slow
@pytest.mark.parametrize(("moves", "cause"), [(0, "task refused"), (3, "task failed")])
def test_a_task_that_was_never_begun_is_refused_and_any_other_has_failed(
    config: MakeConfig, moves: int, cause: str
) -> None:
    program = f'executor = "wave_levels:Program"\nparams = {{ moves = {moves} }}'
    text = PLAIN.replace('executor = "wave_levels:Watch"', program).replace('below = "wave"\n', "")
    assert run(Rack(config(text=text))).cause == cause


@pytest.mark.slow
@pytest.mark.parametrize(("seconds", "ticks"), [(0.1, 40), (0.0025, 1), (0.5051, 202)])
def test_a_run_of_given_length_ends_at_its_exact_tick(
    config: MakeConfig, seconds: float, ticks: int
) -> None:
    rack = Rack(config())
    outcome = run(rack, seconds)
    assert (outcome.cause, outcome.ticks) == ("time over", ticks)
    assert rack.segment.words[System.TICK] == ticks - 1
    assert rack.segment.block("wave")[Block.CYCLES] == ticks


@pytest.mark.slow
def test_events_report_the_run_in_order(config: MakeConfig) -> None:
    received: list[Event] = []
    rack = Rack(config(), received.append)
    run(rack, 0.1)
    assert received == rack.events
    assert [event.kind for event in received if event.kind not in ("ready", "waiting")] == [
        "launch",
        "start",
        "end",
    ]
    assert (received[0].tick, received[-1].tick, received[-1].text) == (
        -1,
        39,
        "time over after 40 ticks",
    )
    assert [event.time_ns for event in received] == sorted(event.time_ns for event in received)


@pytest.mark.slow
def test_output_of_a_board_becomes_an_event(config: MakeConfig) -> None:
    rack = Rack(config("board.wave.params={ trouble = 'print', at = 5 }"))
    run(rack, 0.1)
    assert [event.text for event in rack.events if event.kind == "printed"] == ["a wave 5"]


def test_boards_are_ready_before_the_clock_runs(config: MakeConfig) -> None:
    with Rack(config()) as rack:
        words = rack.segment.words
        assert (words[System.STATE], words[System.TICK]) == (Run.STARTING, 0)
        assert UtilityLines(rack.segment).sysfail == []
        states = {
            t.name: rack.segment.block(t.name)[Block.STATE] for t in rack.segment.layout.tasks
        }
        assert all(TaskState.READY <= state <= TaskState.RUNNING for state in states.values())
        assert rack.run(0.1).cause == "time over"
    states = {t.name: rack.segment.block(t.name)[Block.STATE] for t in rack.segment.layout.tasks}
    assert set(states.values()) == {TaskState.ENDED}


@pytest.mark.slow
def test_after_the_launch_only_the_segment_has_a_name(config: MakeConfig) -> None:
    with Rack(config("protocol.default=lock")) as rack:
        folder = shm_path(rack.config.name).parent
        assert [p.name for p in folder.iterdir() if rack.config.name in p.name] == [
            shm_path(rack.config.name).name
        ]
    assert rack.config.name not in racks()


@pytest.mark.slow
def test_a_stop_ends_the_run_at_the_next_tick(config: MakeConfig) -> None:
    with Rack(config("clock.mode=realtime")) as rack:
        rack.start()
        rack.stop("enough")
        while rack.watch(0.5):
            pass
    assert rack.outcome is not None
    assert (rack.outcome.cause, rack.outcome.worked) == ("stopped", False)
    assert "enough" in [event.text for event in rack.events if event.kind == "stop"]


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["realtime", "lockstep"])
def test_a_stop_from_outside_is_reported_as_one(config: MakeConfig, mode: str) -> None:
    with Rack(config(f"clock.mode={mode}")) as rack:
        rack.start()
        Segment.attach(rack.config.name).words[System.STOP_REQUEST] = 1
        while rack.watch(0.5):
            pass
    assert rack.outcome is not None
    assert rack.outcome.cause == "stopped"


def test_a_run_that_its_crate_cuts_short_ends_in_the_tick_that_it_had_begun(
    config: MakeConfig,
) -> None:
    with Rack(config("clock.mode=realtime")) as rack:
        rack.start()
        words, block = rack.segment.words, rack.segment.block("wave")
        wait_until(lambda: words[System.TICK] > 20)
        before = words[System.TICK]
        os.kill(parent_of(block[Block.PID]), signal.SIGKILL)
        deadline = time.monotonic() + BOUND_S
        while rack.watch(0.5):
            assert time.monotonic() < deadline
        assert rack.outcome is not None
        # The clock may outlive the crate by a moment, in which it begins further ticks, or obeys
        # the Rack, which has seen that the crate is gone.
        assert before + 1 <= rack.outcome.ticks <= words[System.TICK] + 1


@pytest.mark.slow
def test_a_running_racks_name_is_refused_and_the_rack_continues(config: MakeConfig) -> None:
    with Rack(config("clock.mode=realtime")) as first:
        first.start(0.25)
        with pytest.raises(
            SegmentError,
            match=f"rack '{first.config.name}' is already running, launched by process",
        ):
            Rack(config()).launch()
        while first.watch(0.5):
            pass
    assert first.outcome is not None
    assert first.outcome.cause == "time over"


@pytest.mark.slow
def test_racks_running_together_do_not_affect_each_other(
    config: MakeConfig, rack_name: str
) -> None:
    alone = run(Rack(config()), 0.5)
    pair = [Rack(config(f"name={rack_name}-{end}")) for end in ("a", "b")]
    with pair[0], pair[1]:
        for rack in pair:
            rack.start(0.5)
        while pair[0].watch(0.02) | pair[1].watch(0.02):
            pass
    assert [rack.outcome and rack.outcome.digest for rack in pair] == [alone.digest] * 2


@pytest.mark.slow
def test_racks_one_after_the_other_leave_no_file_open(config: MakeConfig) -> None:
    run(Rack(config()), 0.0025)
    before = descriptors()
    for _ in range(2):
        run(Rack(config()), 0.0025)
    assert descriptors() == before


@pytest.mark.slow
def test_a_removed_rack_frees_its_memory(config: MakeConfig) -> None:
    rack = Rack(config())
    run(rack, 0.0025)
    name = shm_path(rack.config.name).name
    maps = Path("/proc/self/maps")
    # Unlinked but still mapped, so the counters of an ended run remain readable.
    assert rack.segment.block("wave")[Block.CYCLES] == 1
    before = maps.read_text().count("(deleted)")
    del rack
    gc.collect()
    assert maps.read_text().count("(deleted)") < before, name


def test_counters_show_the_bus_traffic(config: MakeConfig) -> None:
    rack = Rack(config(text=PLAIN))
    run(rack, 0.4)
    wave, watch = (rack.segment.block(name) for name in ("wave", "watch"))
    size = rack.segment.layout.mailbox("wave.status").size
    assert [wave[w] for w in (Block.CYCLES, Block.WRITES, Block.WRITE_BYTES)] == [
        160,
        160,
        160 * size,
    ]
    # At tick 0 there is nothing yet to read.
    assert [watch[w] for w in (Block.CYCLES, Block.READS, Block.READ_BYTES)] == [20, 20, 19 * size]
    assert [
        block[w] for block in (wave, watch) for w in (Block.MISSED, Block.CORRUPT, Block.BUS_ERRORS)
    ] == [0] * 6


def text_of(events: Sequence[Event], kind: str) -> str:
    return "\n".join(event.text for event in events if event.kind == kind)


@pytest.mark.slow
def test_a_board_that_cannot_have_its_core_is_reported(config: MakeConfig) -> None:
    rack = Rack(config("board.watch.core=1000"))
    with rack:
        assert "core 1000 is not available" in text_of(rack.events, "ready")


def run_limited(
    config: RackConfig, folder: Path, *limits: str, seconds: str = "0.1"
) -> subprocess.CompletedProcess[str]:
    """Run a rack by the command line, under these limits."""
    path = folder / "limited.toml"
    path.write_text(config.text())
    command = [*limits, *RACK, "run", str(path), "--seconds", seconds, "--no-record", "--share"]
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=BOUND_S, check=False
    )


@pytest.mark.slow
@as_root
@pytest.mark.parametrize(
    ("limits", "why"),
    [
        (
            ("prlimit", "--nofile=8"),
            r"Too many open files: at most 8 open files are permitted \(ulimit -n\)",
        ),
        (
            ("prlimit", "--nofile=20"),
            r"rack '.*': at most 20 open files are permitted \(ulimit -n\); the rack needs 3\d",
        ),
        (
            ("prlimit", "--nproc=1", *as_user(ONE_MAY)),
            r"Resource .* unavailable: at most 1 processes are permitted \(ulimit -u\)",
        ),
        (
            ("prlimit", "--nproc=2", *as_user(TWO_MAY)),
            (
                r"board 'wave' cannot be forked: Resource .* at most 2 processes are permitted .*;"
                r" the rack needs 6"
            ),
        ),
        (
            ("prlimit", "--nproc=4", *as_user(FOUR_MAY)),
            (
                r"board 'clock' cannot be forked: Resource .* at most 4 processes are permitted .*;"
                r" the rack needs 6"
            ),
        ),
        (
            (*SMALL, "half"),
            (
                r"rack '.*': \d+ bytes of shared memory: No space left .*: /dev/shm has \d+ bytes,"
                r" \d+ of .*"
            ),
        ),
    ],
)
def test_a_limit_of_the_system_is_one_line_with_its_value(
    config: MakeConfig, tmp_path: Path, limits: tuple[str, ...], why: str
) -> None:
    plain = config(text=PLAIN)
    segment = Segment.create(resolve(plain).layout, plain.text())
    size = len(segment.bytes)
    unlink(segment.rack)
    segment.close()
    half = str(size // mmap.PAGESIZE // 2 * mmap.PAGESIZE)
    words = (half if word == "half" else word for word in limits)
    done = run_limited(plain, tmp_path, *words)
    assert done.returncode == 1
    assert re.fullmatch(why, done.stderr.strip())
    # Racks of other tests may run beside it: it names them.
    assert not [line for line in done.stdout.splitlines() if not line.startswith("waiting: core ")]


@pytest.mark.slow
@as_root
def test_memory_that_could_not_be_locked_is_said_with_its_limit(
    config: MakeConfig, tmp_path: Path
) -> None:
    real_time = config("clock.mode=realtime", text=PLAIN)
    done = run_limited(real_time, tmp_path, "prlimit", f"--memlock={8 << 20}", *PLAIN_ROOT)
    assert (
        done.stdout.count(
            "memory not locked for wave, watch: the limit is 8388608 bytes, a board maps "
        )
        == 1
    )
    assert "memory not locked" not in run_limited(real_time, tmp_path).stdout


@pytest.mark.slow
@as_root
@needs_fifo
def test_lockstep_has_no_deadlines_to_warn_of(config: MakeConfig, tmp_path: Path) -> None:
    lockstep = config("board.wave.priority=5", "clock.on_no_realtime=refuse", text=PLAIN)
    done = run_limited(lockstep, tmp_path, "prlimit", f"--memlock={8 << 20}", *PLAIN_ROOT)
    assert (done.returncode, done.stderr) == (0, "")
    assert not re.search("SCHED_FIFO|missed deadlines|NO REAL-TIME|not locked", done.stdout)


@pytest.mark.slow
@as_root
@pytest.mark.filterwarnings(FORKS)
def test_a_restart_that_the_system_refuses_is_said_and_ends_the_run_in_order(
    config: MakeConfig, tmp_path: Path, rack_name: str
) -> None:
    plain, out = config("clock.mode=realtime", text=PLAIN), tmp_path / "out"

    def run_long() -> None:
        done = run_limited(
            plain, tmp_path, "prlimit", "--nproc=5", *as_user(FIVE_MAY), seconds="60"
        )
        out.write_text(f"{done.returncode} {done.stdout}")

    def occupy() -> None:
        os.setuid(FIVE_MAY)
        time.sleep(BOUND_S)

    def is_full() -> bool:
        assert not out.exists(), out.read_text()
        return users_processes(FIVE_MAY) >= 8

    with ExitStack() as stack:
        runner = stack.enter_context(forked(run_long))
        # A whole command: on a loaded machine its imports alone may take half a minute.
        wait_until(lambda: rack_name in racks(), BOUND_S)
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


def users_processes(uid: int) -> int:
    """Return how many processes a user has."""
    count = 0
    for status in Path("/proc").glob("[0-9]*/status"):
        with suppress(OSError):
            count += f"\nUid:\t{uid}\t" in status.read_text()
    return count
