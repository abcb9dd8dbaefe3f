"""Computation in a separate process with the environment of boards.

This environment makes results equal on every processor. It takes effect only when a process starts.
The same computation in the process of a command may therefore differ in the last bit.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import active_children, get_context
from typing import ParamSpec, TypeVar

from rack.backplane.process import die_with_parent
from rack.boards.crate.line import build_environment
from rack.tools.console.answer import Failure

_P = ParamSpec("_P")
_R = TypeVar("_R")


def run_in_board_environment(work: Callable[_P, _R], *args: _P.args, **kwargs: _P.kwargs) -> _R:
    """Call a function in a new process that has the environment of a board.

    Args:
        work: Function at module level. Arguments and result must be plain data.
        args: Positional arguments.
        kwargs: Keyword arguments.

    Returns:
        The result of `work`.

    Raises:
        Failure: If the process ends without an answer.
        Exception: Any exception that `work` raises.
    """
    spawn = get_context("spawn")
    with ProcessPoolExecutor(1, spawn, die_with_parent, (os.getpid(),)) as pool:
        saved_environment = dict(os.environ)
        os.environ.update(build_environment())
        try:
            # This call starts the process.
            answer = pool.submit(work, *args, **kwargs)
        finally:
            os.environ.clear()
            os.environ.update(saved_environment)
        try:
            return answer.result()
        except BrokenProcessPool:
            raise Failure("the process that measures ended without a result") from None
        finally:
            # After an interrupt, do not wait for the result.
            for process in active_children():
                process.kill()
