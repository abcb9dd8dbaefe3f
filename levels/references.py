"""Import of classes that a config names as "package.module:Name"."""

from __future__ import annotations

import importlib
import inspect
import os
import signal
import sys
from contextlib import suppress
from functools import cache
from types import ModuleType
from typing import TypeVar

from rack.backplane.process import describe_end, die_with_parent, wait_readable

T = TypeVar("T")
SLOW_S = 2.0
"""Duration of an import, in s, after which the user is told that it is still running."""
MAX_IMPORT_S = 60.0
"""Duration of an import, in s, after which the module is refused."""
IMPORTED_STATUS = 117
"""Exit status of a child that has completed an import. Few modules exit with it themselves."""


def import_reference(reference: str, in_child_first: bool = True) -> tuple[ModuleType, str]:
    """Import the module of a reference "package.module:Name".

    Args:
        reference: The reference.
        in_child_first: True to try the import in a child process first, so that a user's module
            cannot end or block this process.

    Returns:
        The module, and "Name".

    Raises:
        LookupError: The module cannot be imported.
    """
    module, _, name = reference.partition(":")
    is_new = module not in sys.modules and not module.startswith("rack.")
    try:
        if in_child_first and is_new and (reason := _try_import(module)):
            raise ImportError(reason)
        return importlib.import_module(module), name
    # A user's module may raise anything while it is imported.
    except (Exception, SystemExit) as error:
        raise LookupError(f"cannot import '{module}': {type(error).__name__}: {error}") from error


def find_class(reference: str, base: type[T], in_child_first: bool = True) -> type[T]:
    """Return the subclass of `base` that a reference "package.module:Class" names.

    Args:
        reference: The reference.
        base: The required base class.
        in_child_first: As for `import_reference`.

    Raises:
        LookupError: The class is missing, abstract, or not a subclass of `base`.
    """
    module, name = import_reference(reference, in_child_first)
    named = getattr(module, name, None)
    if not isinstance(named, type) or not issubclass(named, base):
        kinds = [
            n
            for n, c in inspect.getmembers(module, inspect.isclass)
            if issubclass(c, base) and c is not base
        ]
        problem = "has no class" if named is None else f"has no {base.__name__} named"
        raise LookupError(
            f"module '{module.__name__}' {problem} '{name}'; it has: {', '.join(kinds) or 'none'}"
        )
    if inspect.isabstract(named):
        missing = ", ".join(sorted(getattr(named, "__abstractmethods__", ())))
        raise LookupError(f"class '{name}' does not implement: {missing}")
    return named


# Each of the many checks of a config may need the module.
@cache
def _try_import(module: str) -> str:
    """Import a module in a child process, to find out whether this process may import it.

    Returns:
        The reason why this process must not import the module: the import ends the process or takes
        too long. Empty if it may import it, even if the module raises an exception.
    """
    parent = os.getpid()
    try:
        child = os.fork()
    except OSError:
        # The launch reports which limit is reached.
        return ""
    if child == 0:
        try:
            # Only the parent responds to signals from the terminal.
            os.setsid()
            die_with_parent(parent)
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            with suppress(Exception, SystemExit):
                importlib.import_module(module)
            os._exit(IMPORTED_STATUS)
        finally:
            os._exit(1)
    ended = os.pidfd_open(child)
    try:
        if not wait_readable(ended, SLOW_S):
            sys.stderr.write(f"still importing '{module}'; it may take {MAX_IMPORT_S:g} s\n")
            sys.stderr.flush()
        is_over = wait_readable(ended, MAX_IMPORT_S - SLOW_S)
    finally:
        os.kill(child, signal.SIGKILL)
        status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        os.close(ended)
    if not is_over:
        return f"it did not finish within {MAX_IMPORT_S:g} s"
    return "" if status == IMPORTED_STATUS else f"it ended the process: {describe_end(status)}"
