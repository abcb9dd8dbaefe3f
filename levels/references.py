"""What a config names as "package.module:Name", imported; also by the names that earlier versions had for it."""

from __future__ import annotations

import importlib
from types import ModuleType

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
"""Packages, modules and classes that have moved: the configs of users and of saved runs name their old places."""


def current(reference: str) -> str:
    """Return the present name of "package.module:Name"."""
    for old, new in MOVED.items():
        rest = reference.removeprefix(old)
        if rest != reference and rest[:1] in ("", ".", ":"):
            return new + rest
    return reference


def module_and_name(reference: str) -> tuple[ModuleType, str]:
    """Return the module that "package.module:Name" names, imported, and the name in it. Raises `LookupError`."""
    module, _, name = current(reference).partition(":")
    try:
        return importlib.import_module(module), name
    except (Exception, SystemExit) as error:  # a user's module may raise anything while it is imported
        raise LookupError(f"cannot import '{module}': {type(error).__name__}: {error}") from error
