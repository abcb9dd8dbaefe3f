"""The processor under a task: core, priority, memory, and the garbage collector."""

from __future__ import annotations

import ctypes
import gc
import os
import signal
from dataclasses import dataclass

from rack.backplane.layout import TaskSpec
from rack.backplane.process import pin

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_PR_SET_NAME, _PR_SET_PDEATHSIG = 15, 1
_libc = ctypes.CDLL(None, use_errno=True)


@dataclass(frozen=True)
class Processor:
    """What a task obtained: its core, its SCHED_FIFO priority (0: ordinary), whether its memory is locked."""

    core: int
    priority: int
    locked: bool


def take_processor(spec: TaskSpec) -> Processor:
    """Pin the calling process, take its priority if allowed, lock its memory, stop the garbage collector."""
    pin(spec.core)
    priority = spec.priority if set_priority(spec.priority) else 0
    # On fault: locking every page at once would copy all that the boards share since their fork.
    locked = _libc.mlockall(_MCL_CURRENT | _MCL_FUTURE | _MCL_ONFAULT) == 0
    gc.freeze()
    gc.disable()
    return Processor(spec.core, priority, locked)


def set_priority(priority: int) -> bool:
    """Take a SCHED_FIFO priority, 0 for ordinary scheduling; False when the system refuses it."""
    policy = os.SCHED_FIFO if priority else os.SCHED_OTHER
    try:
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except PermissionError:
        return False
    return True


def name_process(name: str) -> None:
    """Give the calling process the name that `top` and `ps` show, 15 characters."""
    _libc.prctl(_PR_SET_NAME, name.encode()[:15], 0, 0, 0)


def die_with_parent(parent: int) -> None:
    """Have the kernel kill the calling process when its parent ends, however that ends."""
    _libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    # The parent may have ended between fork and prctl.
    if os.getppid() != parent:
        os._exit(1)
