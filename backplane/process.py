"""Processes: alive or not, on which core, at which priority."""

from __future__ import annotations

import ctypes
import errno
import os
import platform
import re
import select
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from resource import RLIMIT_NOFILE, RLIMIT_NPROC, getrlimit
from struct import Struct
from time import process_time_ns
from typing import NamedTuple

GONE = "ZX"
"""States of a process that has ended."""
WAITING = "SD"
"""States of a process that waits."""
_TICKS_A_SECOND = os.sysconf("SC_CLK_TCK")
STOPPED = "Tt"
"""States of a process stopped by a signal or a debugger."""


def start_time(pid: int) -> int:
    """Return the start time of a process, in kernel clock ticks since boot; 0 when there is none or
    it is a zombie.
    """
    fields = _stat(pid)
    return int(fields[19]) if fields and fields[0] not in GONE else 0


def state_of(pid: int) -> str:
    """Return the kernel's letter for a process's state: R, S, D, T (stopped), Z (dead, not reaped);
    X: no process.
    """
    return (_stat(pid) or "X")[0]


def processor_ns(pid: int) -> int:
    """Return the processor time used by a process so far, in ns, to about 10 ms; 0 when there is
    none.
    """
    fields = _stat(pid)
    return (int(fields[11]) + int(fields[12])) * (1_000_000_000 // _TICKS_A_SECOND) if fields else 0


def _stat(pid: int) -> list[str]:
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except (FileNotFoundError, ProcessLookupError):
        return []
    # The command name, in parentheses, may itself hold spaces and parentheses.
    return stat.rpartition(")")[2].split()


def is_alive(pid: int, started: int = 0) -> bool:
    """Say whether a process is alive; with `started`, whether it is still the same process, since
    pids are reused.
    """
    found = start_time(pid) if pid > 0 else 0
    return bool(found) and started in (0, found)


def readable(fd: int, timeout_s: float) -> bool:
    """Wait until a descriptor can be read, or the process of a pidfd has ended; False after the
    timeout.

    Unlike `select` this takes descriptors above 1023.
    """
    waiting = select.poll()
    waiting.register(fd, select.POLLIN)
    return bool(waiting.poll(max(0.0, timeout_s) * 1000))


def compute_until(processor_time_ns: int) -> None:
    """Compute until the calling process has used that much processor time (`process_time_ns`:
    without preemption).
    """
    while process_time_ns() < processor_time_ns:
        pass


def pin(core: int) -> None:
    """Pin the calling process to one core. Raises `OSError` when the machine lacks it."""
    os.sched_setaffinity(0, {core})


LATENCY_REQUEST = Path("/dev/cpu_dma_latency")
"""Device that takes the longest permitted wake-up time of a core, us, while it is open."""
_PR_SET_NAME = 15
_PR_SET_PDEATHSIG = 1
_PR_SET_TIMERSLACK = 29
_PR_SET_CHILD_SUBREAPER = 36
_libc = ctypes.CDLL(None, use_errno=True)


DEADLINE = 100
"""Stands for SCHED_DEADLINE among SCHED_FIFO's priorities, which end at 99: it precedes all."""
SCHED_DEADLINE = 6
_RESET_ON_FORK = 1
_RECLAIM = 2
"""Lets a process that exceeds its reservation use what others leave: a first cycle takes longer."""
_SCHED_SETATTR = {"x86_64": 314, "aarch64": 274}
"""Number of the system call, by machine: the C library has no function for it."""


class Reservation(NamedTuple):
    """Processor time under SCHED_DEADLINE: so much in each period, before its end."""

    runtime_ns: int
    period_ns: int


def take_core(core: int, priority: int, reservation: Reservation | None = None) -> int:
    """Pin the calling process to a core and, if allowed, a reservation or else a priority.

    Return the SCHED_FIFO priority obtained; 0: ordinary scheduling; `DEADLINE`: the reservation.
    """
    everywhere = os.sched_getaffinity(0)
    pin(core)
    if reservation is not None:
        # A pinned process is admitted only where the kernel does not add up what is reserved.
        for cores in ({core}, everywhere):
            os.sched_setaffinity(0, cores)
            if _reserve(reservation):
                return DEADLINE
        pin(core)
    return priority if set_priority(priority) else 0


def _reserve(reservation: Reservation) -> bool:
    """Take SCHED_DEADLINE; False when the system refuses it."""
    runtime_ns, period_ns = reservation
    times = runtime_ns, period_ns, period_ns
    record = Struct("=IIQiIQQQ")
    wanted = record.pack(record.size, SCHED_DEADLINE, _RESET_ON_FORK | _RECLAIM, 0, 0, *times)
    number = _SCHED_SETATTR.get(platform.machine())
    return number is not None and _libc.syscall(number, 0, wanted, 0) == 0


def wake_up_exactly() -> None:
    """Let the calling process, if it is an ordinary one, sleep as long as it wants and no longer:
    to save power, the system wakes such processes up to 50 us late.
    """
    _libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)


@contextmanager
def cores_kept_awake() -> Iterator[str]:
    """Keep every core from sleeping while it is idle; yield why the system refuses that, empty if
    it permits it.

    A core that sleeps takes 20 us and more to wake up. But one that is held awake spins: a host
    that gives a virtual machine a quota of processor time counts that, and takes the core away for
    ms once the quota is used up. As a rule the system permits it to root only. The request ends
    with the process, however that ends: https://docs.kernel.org/power/pm_qos_interface.html
    """
    refusal = ""
    with ExitStack() as stack:
        try:
            stack.enter_context(LATENCY_REQUEST.open("r+b", 0)).write(bytes(4))
        except OSError as error:
            refusal = (
                f"idle cores sleep, since {LATENCY_REQUEST} cannot be opened: {error.strerror}"
            )
        yield refusal


def mapped_and_locked(pid: int) -> tuple[int, int]:
    """Return the bytes of memory that a process has mapped, and those locked; 0 when there is no
    process.
    """
    found: list[str] = []
    with suppress(FileNotFoundError, ProcessLookupError):
        found = re.findall(r"Vm(?:Size|Lck):\s*(\d+)", Path(f"/proc/{pid}/status").read_text())
    mapped, locked = (int(kib) << 10 for kib in found or "00")
    return mapped, locked


def refusal(error: OSError) -> str:
    """Return why the system refused a process or a file, with the limit that is reached."""
    limits = {
        errno.EAGAIN: ("processes", "u", RLIMIT_NPROC),
        errno.EMFILE: ("open files", "n", RLIMIT_NOFILE),
    }
    if error.errno not in limits:
        return str(error)
    what, option, limit = limits[error.errno]
    return (
        f"{error.strerror}: at most {getrlimit(limit)[0]} {what} are permitted (ulimit -{option})"
    )


def set_priority(priority: int) -> bool:
    """Take a SCHED_FIFO priority, 0 for ordinary scheduling; False when the system refuses it."""
    policy = os.SCHED_FIFO if priority else os.SCHED_OTHER
    try:
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except PermissionError:
        return False
    return True


COPY = "copy:"
"""Begins the names of processes that are part of a snapshot."""


def name_process(name: str) -> None:
    """Set the name of the calling process in `top` and `ps`, 15 characters."""
    _libc.prctl(_PR_SET_NAME, name.encode()[:15], 0, 0, 0)


def die_with_parent(parent: int) -> None:
    """Let the kernel kill the calling process when its parent ends, for whatever reason."""
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    # The parent may have ended between fork and prctl.
    if os.getppid() != parent:
        os._exit(1)


def adopt_orphans() -> None:
    """Become the parent of descendants whose own parents have ended, whatever their sessions."""
    _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def how_ended(status: int) -> str:
    """Return how a process ended, by its exit status; those below 0 stand for signals."""
    return f"signal {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"


def children_of(parent: int) -> set[int]:
    """Return the children of a process, those that have ended and are not reaped included."""
    pids = [int(entry.name) for entry in Path("/proc").glob("[0-9]*")]
    return {pid for pid in pids if _stat(pid)[1:2] == [str(parent)]}
