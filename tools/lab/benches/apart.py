"""Computation in a separate process with the environment of boards.

This environment makes results equal on every processor. It takes effect only when a process starts.
The same computation in the process of a command may therefore differ in the last bit.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, ParamSpec, TypeVar

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
    spawn = multiprocessing.get_context("spawn")
    own_end, other_end = spawn.Pipe()
    call = (other_end, os.getpid(), work, args, kwargs)
    process = spawn.Process(target=_answer_call, args=call, daemon=True)
    saved_environment = dict(os.environ)
    os.environ.update(build_environment())
    try:
        process.start()
    finally:
        os.environ.clear()
        os.environ.update(saved_environment)
    other_end.close()
    try:
        answer, error = own_end.recv()
    except EOFError:
        process.join()
        raise Failure(f"the process that measures ended with status {process.exitcode}") from None
    finally:
        process.kill()
        process.join()
    if error is not None:
        raise error
    result: _R = answer
    return result


def _answer_call(
    pipe: Connection, parent: int, work: Callable[..., Any], args: Any, kwargs: dict[str, Any]
) -> None:
    """Call the function in the new process, and send the result or the exception."""
    die_with_parent(parent)
    try:
        pipe.send((work(*args, **kwargs), None))
    except Exception as error:
        pipe.send((None, error))
