"""Work in a process of its own, in the environment of boards.

That environment makes results equal on every processor. It takes effect only when a process starts,
so the same computation done in the process of a command may differ from a board's in the last bit.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any, ParamSpec, TypeVar

from rack.backplane.process import die_with_parent
from rack.boards.crate.line import environment
from rack.tools.console.answer import Failure

_P = ParamSpec("_P")
_R = TypeVar("_R")


def apart(work: Callable[_P, _R], *args: _P.args, **kwargs: _P.kwargs) -> _R:
    """Return what `work` returns, called in such a process; it must be a function of a module, its
    values plain data.

    Raises:
        Failure: If the process ends without an answer.
        Exception: What `work` raises.
    """
    spawn = multiprocessing.get_context("spawn")
    ours, theirs = spawn.Pipe()
    call = (theirs, os.getpid(), work, args, kwargs)
    process = spawn.Process(target=_work, args=call, daemon=True)
    own = dict(os.environ)
    os.environ.update(environment())
    try:
        process.start()
    finally:
        os.environ.clear()
        os.environ.update(own)
    theirs.close()
    try:
        answer, error = ours.recv()
    except EOFError:
        process.join()
        why = f"the process that measures ended with status {process.exitcode}"
        raise Failure(why) from None
    finally:
        process.kill()
        process.join()
    if error is not None:
        raise error
    result: _R = answer
    return result


def _work(
    pipe: Connection, parent: int, work: Callable[..., Any], args: Any, kwargs: dict[str, Any]
) -> None:
    die_with_parent(parent)
    try:
        pipe.send((work(*args, **kwargs), None))
    except Exception as error:
        pipe.send((None, error))
