"""Work in a process of its own, in the environment of boards.

That environment makes results equal on every processor. It takes effect only when a process starts,
so the same computation done in the process of a command may differ from a board's in the last bit.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from typing import ParamSpec, TypeVar

from rack.backplane.process import die_with_parent
from rack.boards.crate.line import environment
from rack.tools.console.answer import Failure

_P = ParamSpec("_P")
_R = TypeVar("_R")


def apart(work: Callable[_P, _R], *args: _P.args, **kwargs: _P.kwargs) -> _R:
    """Return what `work` returns, called in such a process; it must be a function of a module, its
    values plain data.

    Raises what it raises. Raises `Failure` if the process ends without an answer.
    """
    ours, theirs = Pipe()
    command = [
        sys.executable,
        "-P",
        "-m",
        "rack.tools.lab.benches.apart",
        str(theirs.fileno()),
        str(os.getpid()),
    ]
    with (
        ours,
        subprocess.Popen(
            command, pass_fds=[theirs.fileno()], env=environment(), stdin=subprocess.DEVNULL
        ) as process,
    ):
        theirs.close()
        try:
            ours.send(sys.path)
            ours.send((work, args, kwargs))
            answer, error = ours.recv()
        except (EOFError, OSError):
            raise Failure(f"the process that measures ended with status {process.wait()}") from None
        finally:
            process.kill()
    if error is not None:
        raise error
    result: _R = answer
    return result


def main() -> None:
    """Do the work that comes through the inherited pipe."""
    line, parent = (int(argument) for argument in sys.argv[1:])
    die_with_parent(parent)
    with Connection(line) as pipe:
        sys.path[:] = pipe.recv()
        work, args, kwargs = pipe.recv()
        try:
            pipe.send((work(*args, **kwargs), None))
        except Exception as error:
            pipe.send((None, error))


if __name__ == "__main__":
    main()
