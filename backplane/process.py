"""State, core, priority and memory of processes, from the kernel."""

from __future__ import annotations

import ctypes
import errno
import os
import re
import select
import signal
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from resource import RLIMIT_NOFILE, RLIMIT_NPROC, getrlimit
from struct import Struct
from time import process_time_ns
from typing import NamedTuple, TextIO

ENDED_STATES = "ZX"
"""States of a process that has ended."""
WAITING_STATES = "SD"
"""States of a process that waits."""
_EXITING = 0x4
"""PF_EXITING of linux/sched.h, among the flags in /proc/<pid>/stat."""
_TICKS_A_SECOND = os.sysconf("SC_CLK_TCK")
STOPPED_STATES = "Tt"
"""States of a process stopped by a signal or a debugger."""


def read_state(pid: int) -> str:
    """Return the kernel's letter for the state of a process.

    Common letters are R (running), S and D (waiting), T (stopped) and Z (ended, not reaped). The
    result is X if the process does not exist.
    """
    return (_read_stat(pid) or "X")[0]


def read_processor_ns(pid: int) -> int:
    """Return the processor time that a process has used, in ns, with a resolution of about 10 ms.

    The result is 0 if the process does not exist.
    """
    fields = _read_stat(pid)
    return (int(fields[11]) + int(fields[12])) * (1_000_000_000 // _TICKS_A_SECOND) if fields else 0


def _read_stat(pid: int) -> list[str]:
    """Return the fields of /proc/<pid>/stat after the command name.

    The list is empty if the process does not exist.
    """
    try:
        stat = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except (FileNotFoundError, ProcessLookupError):
        return []
    # The command name, in parentheses, may contain spaces and parentheses.
    return stat.rpartition(")")[2].split()


def is_ending(pid: int) -> bool:
    """Check whether a process has ended, or is being removed and no longer runs its own code.

    A killed process with much memory remains in state R until its memory is free, for 10 ms or so.
    """
    fields = _read_stat(pid)
    return not fields or fields[0] in ENDED_STATES or bool(int(fields[6]) & _EXITING)


def is_alive(pid: int) -> bool:
    """Check whether a process is alive."""
    return pid > 0 and read_state(pid) not in ENDED_STATES


def wait_readable(fd: int, timeout_s: float) -> bool:
    """Wait until a descriptor is readable. A pidfd becomes readable when its process ends.

    Unlike `select`, this accepts descriptors above 1023.

    Returns:
        False on timeout.
    """
    waiting = select.poll()
    waiting.register(fd, select.POLLIN)
    return bool(waiting.poll(max(0.0, timeout_s) * 1000))


def write_line(file: TextIO, text: str) -> None:
    """Write a line in one system call.

    The line stays whole if other threads or processes write to the same file. `print` writes a text
    and its end of line separately where output is not buffered.
    """
    os.write(file.fileno(), f"{text}\n".encode(errors="backslashreplace"))


def busy_wait_until(processor_time_ns: int) -> None:
    """Busy-wait until the processor time of the calling process reaches a value.

    Args:
        processor_time_ns: Total processor time, as returned by `time.process_time_ns`.
    """
    while process_time_ns() < processor_time_ns:
        pass


def pin_to_core(core: int) -> None:
    """Pin the calling process to one core.

    Raises:
        OSError: The machine does not have this core.
    """
    os.sched_setaffinity(0, {core})


LATENCY_REQUEST = Path("/dev/cpu_dma_latency")
"""Device that limits the wake-up latency of idle cores while it is open.

The limit is written to it as an integer, in us.
"""
_PR_SET_NAME = 15
_PR_SET_PDEATHSIG = 1
_PR_SET_TIMERSLACK = 29
_PR_SET_CHILD_SUBREAPER = 36
_libc = ctypes.CDLL(None, use_errno=True)


DEADLINE = 100
"""Number that stands for SCHED_DEADLINE where a SCHED_FIFO priority (1 to 99) is expected."""
SCHED_DEADLINE = 6
_RESET_ON_FORK = 1
_RECLAIM = 2
"""Flag that lets a process exceed its reservation while other reservations are unused.

A first cycle needs this, because it takes longer than the later ones.
"""
_SCHED_SETATTR = 314
"""System call number on x86-64, since the C library has no function for it."""


class Reservation(NamedTuple):
    """Processor time under SCHED_DEADLINE: `runtime_ns` within each period of `period_ns`."""

    runtime_ns: int
    period_ns: int


def take_core(core: int, priority: int, reservation: Reservation | None) -> int:
    """Pin the calling process to a core and raise its priority, if allowed.

    Args:
        core: Processor core.
        priority: SCHED_FIFO priority, used if there is no reservation or the system refuses it.
        reservation: Processor time to reserve on the core under SCHED_DEADLINE.

    Returns:
        The SCHED_FIFO priority obtained, `DEADLINE` for the reservation, or 0 for ordinary
            scheduling.
    """
    pin_to_core(core)
    if reservation is not None and not reserve_time(reservation):
        return DEADLINE
    return priority if set_priority(priority) else 0


def reserve_time(reservation: Reservation, pid: int = 0) -> str:
    """Switch a process to SCHED_DEADLINE on the core to which it is pinned.

    Args:
        reservation: Processor time to reserve.
        pid: The process, 0 for the calling one.

    Returns:
        Why the system refuses. Empty if it does not.
    """
    runtime_ns, period_ns = reservation
    times = runtime_ns, period_ns, period_ns
    record = Struct("=IIQiIQQQ")
    attributes = record.pack(record.size, SCHED_DEADLINE, _RESET_ON_FORK | _RECLAIM, 0, 0, *times)
    if _libc.syscall(_SCHED_SETATTR, pid, attributes, 0) == 0:
        return ""
    code = ctypes.get_errno()
    why = os.strerror(code)
    return f"{why}; {PERMITS_RESERVATIONS}" if code == errno.EPERM else why


PERMITS_RESERVATIONS = (
    "time on one core is reserved only as root, with kernel.sched_rt_runtime_us = -1 or in an"
    " exclusive cpuset (clock.exclusive_cores)"
)
"""Advice on obtaining reservations."""


def disable_timer_slack() -> None:
    """Disable the kernel's timer slack for the calling process.

    By default the kernel wakes ordinary processes up to 50 us late, to save power.
    """
    _libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)


@contextmanager
def keep_cores_awake() -> Iterator[str]:
    """Prevent idle cores from entering sleep states during a `with` block.

    A sleeping core takes 20 us or more to wake up. An idle core that may not sleep spins instead.
    On a virtual machine with a quota of processor time, spinning uses up the quota, and the host
    then withholds the core for milliseconds. As a rule only root may request this. The request ends
    with the process, however the process ends:
    https://docs.kernel.org/power/pm_qos_interface.html

    Yields:
        The reason why the system refuses the request. Empty if it was granted.
    """
    refusal = ""
    with ExitStack() as stack:
        try:
            stack.enter_context(LATENCY_REQUEST.open("r+b", 0)).write(bytes(4))
        except OSError as error:
            refusal = (
                f"idle cores sleep, because {LATENCY_REQUEST} cannot be opened: {error.strerror}"
            )
        yield refusal


def read_memory_sizes(pid: int) -> tuple[int, int]:
    """Return the sizes of a process's mapped memory and of its locked memory, in bytes.

    Both are 0 if the process does not exist.
    """
    sizes_kib: list[str] = []
    with suppress(FileNotFoundError, ProcessLookupError):
        sizes_kib = re.findall(r"Vm(?:Size|Lck):\s*(\d+)", Path(f"/proc/{pid}/status").read_text())
    mapped, locked = (int(kib) << 10 for kib in sizes_kib or "00")
    return mapped, locked


def describe_refusal(error: OSError) -> str:
    """Return the text of an OS error, with the limit if too many processes or files caused it."""
    limits = {
        errno.EAGAIN: ("processes", "u", RLIMIT_NPROC),
        errno.EMFILE: ("open files", "n", RLIMIT_NOFILE),
    }
    if error.errno not in limits:
        return str(error)
    resource, option, limit = limits[error.errno]
    return f"{error.strerror}: the limit is {getrlimit(limit)[0]} {resource} (ulimit -{option})"


def set_priority(priority: int, pid: int = 0) -> bool:
    """Set the SCHED_FIFO priority of a process. 0 selects ordinary scheduling.

    Args:
        priority: The priority.
        pid: The process, 0 for the calling one.

    Returns:
        False if the system refuses.
    """
    try:
        os.sched_setscheduler(
            pid, os.SCHED_FIFO if priority else os.SCHED_OTHER, os.sched_param(priority)
        )
    except (PermissionError, ProcessLookupError):
        return False
    return True


COPY_PREFIX = "copy:"
"""Prefix of the names of processes that belong to a snapshot."""


def name_process(name: str) -> None:
    """Set the name of the calling process in `top` and `ps`, at most 15 characters."""
    _libc.prctl(_PR_SET_NAME, name.encode()[:15], 0, 0, 0)


def die_with_parent(parent: int) -> None:
    """Have the kernel kill the calling process when its parent ends for any reason."""
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    # The parent may have ended between fork and prctl.
    if os.getppid() != parent:
        os._exit(1)


def adopt_orphans() -> None:
    """Become a child subreaper: the new parent of every descendant whose own parent ends."""
    _libc.prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def describe_end(status: int) -> str:
    """Describe how a process ended.

    Args:
        status: Exit status, or the negative number of the signal that ended the process.
    """
    return f"signal {signal.Signals(-status).name}" if status < 0 else f"exit status {status}"


def list_children(parent: int) -> set[int]:
    """Return the process ids of the children of a process, including unreaped ones."""
    pids = [int(entry.name) for entry in Path("/proc").glob("[0-9]*")]
    return {pid for pid in pids if _read_stat(pid)[1:2] == [str(parent)]}
