"""What a config names as "package.module:Name", imported; also by the names that earlier versions
had for it."""

from __future__ import annotations

import importlib
import os
import select
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from types import ModuleType

SLOW_S = 2.0
IMPORT_S = 60.0
"""Time after which a user hears that a module is still being imported, and after which the process
is ended."""

MOVED = {
    "rack.boards.adapters": "rack.boards.host",
    "rack.levels.arm.sharing": "rack.levels.systems.cell.sharing_arm",
    "rack.levels.cell": "rack.levels.systems.cell",
    "rack.levels.figures": "rack.levels.systems.figures",
    "rack.levels.force": "rack.levels.systems.force",
    "rack.levels.hand": "rack.levels.systems.hand",
    "rack.levels.servo:ArmExecutor": "rack.levels.systems.joint_boards:ArmExecutor",
    "rack.levels.servo:JointGateway": "rack.levels.systems.joint_boards:JointGateway",
    "rack.levels.servo:JointServo": "rack.levels.systems.joint_boards:JointServo",
    "rack.levels.servo:SharingServoExecutor": "rack.levels.systems.cell:SharingServoExecutor",
    "rack.levels.shared_bodies": "rack.levels.systems.cell.shared_bodies",
    "rack.levels.state_table": "rack.levels.systems.state_table",
    "rack.levels.trajectory": "rack.levels.systems.trajectory",
}
"""Packages, modules and classes that have moved: the configs of users and of saved runs name their
old places."""


def current(reference: str) -> str:
    """Return the present name of "package.module:Name"."""
    for old, new in MOVED.items():
        rest = reference.removeprefix(old)
        if rest != reference and rest[:1] in ("", ".", ":"):
            return new + rest
    return reference


def module_and_name(reference: str) -> tuple[ModuleType, str]:
    """Return the module that "package.module:Name" names, imported, and the name in it. Raises
    `LookupError`."""
    module, _, name = current(reference).partition(":")
    is_ours = module in sys.modules or module.startswith("rack.")
    try:
        with nullcontext() if is_ours else _watched(module):
            return importlib.import_module(module), name
    except (
        Exception,
        SystemExit,
    ) as error:  # a user's module may raise anything while it is imported
        raise LookupError(f"cannot import '{module}': {type(error).__name__}: {error}") from error


@contextmanager
def _watched(module: str) -> Iterator[None]:
    """Let a process watch the import of a user's module: one that ends this process, or loops,
    could not be named."""
    asked, told = os.pipe()
    watcher = os.fork()
    if watcher == 0:
        os.close(told)
        _watch(module, asked)
        os._exit(0)
    os.close(asked)
    try:
        yield
    finally:
        os.write(told, b"done")
        os.close(told)
        os.waitpid(watcher, 0)


def _watch(module: str, asked: int) -> None:
    """Wait until the parent has imported the module, or is gone; end it if it takes too long."""
    # Ctrl-C reaches the whole group, but the parent decides how it ends.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if not select.select([asked], [], [], SLOW_S)[0]:
        _say(f"importing '{module}', at most {IMPORT_S:g} s")
        if not select.select([asked], [], [], IMPORT_S - SLOW_S)[0]:
            _say(f"'{module}' was not imported within {IMPORT_S:g} s")
            os.kill(os.getppid(), signal.SIGTERM)
            if not select.select([asked], [], [], SLOW_S)[0]:
                os.kill(os.getppid(), signal.SIGKILL)
            return
    if not os.read(asked, 1):
        _say(f"'{module}' ended the process while it was imported")


def _say(text: str) -> None:
    os.write(2, f"{text}\n".encode())
