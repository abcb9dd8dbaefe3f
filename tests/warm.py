"""Programs that tests start often, ready to run: forked from a process that has their libraries.

Each rack has a crate and most have a recorder, and to import numpy, pydantic and pyarrow for them
would be most of the suite's processor time. A stock process imports a program's libraries, for a
crate also the machine code of an arm's levels, and runs nothing of the program. Each start is a
fork of it that runs the program from the top of its `__main__` on: a child of the test's process,
with the arguments, environment, folder and descriptors that `subprocess` would give it.

What such a fork would not inherit starts as ever: in a process that a test has forked, or whose
user, limits, processors, namespaces or ignored signals are not those that the tests began with.

Commands that tests start by `Popen` or `run_command` come from a stock as well, and fork crate and
recorder from themselves. Tests of how commands start (imports, streams, interpreter options) start
them by `subprocess`.
"""

from __future__ import annotations

import atexit
import ctypes
import fcntl
import gc
import importlib
import os
import pickle
import resource
import runpy
import signal
import socket
import subprocess
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from threading import Lock
from types import SimpleNamespace
from typing import Any, NamedTuple, NoReturn

from rack.backplane.process import list_children
from rack.boards.crate import line
from rack.boards.crate.line import build_environment
from rack.tools.console.interrupt import SIGNALS
from rack.tools.launch import other_racks
from rack.tools.recording.recorder import process as recorder_process

CRATE = "rack.boards.crate"
RECORDER = "rack.tools.recording.recorder"
COMMAND = "rack.tools.cli"
LAUNCHERS = ("tests.boards.launcher", "tests.boards.lan.racks")
"""Programs of tests that launch racks, as a user's program does."""
STARTERS = (line, recorder_process)
"""Modules that start a rack's programs by `subprocess`."""
LIBRARIES = {
    CRATE: ("rack.boards.crate.crate",),
    RECORDER: (
        "numpy.strings",
        "rack.boards.config.commands",
        "rack.levels.systems.joint_boards.messages",
        "rack.tools.recording.recorder.recorder",
        "rack.tools.viewer.sink",
    ),
}
"""What each program imports."""
LIBRARIES[COMMAND] = (
    *LIBRARIES[CRATE],
    *LIBRARIES[RECORDER],
    "rack.tools.commands.check",
    "rack.tools.commands.run",
    "rack.tools.report.report_markdown",
    "typer",
)
LIBRARIES.update(dict.fromkeys(LAUNCHERS, (*LIBRARIES[CRATE], "tests.boards.lan.racks")))
PR_SET_CHILD_SUBREAPER = 36
FIRST_FREE = 1 << 10
"""Descriptors wait up here for their own numbers, so that none takes another's."""
MOST_FDS = 8
MOST_BYTES = 1 << 17


class Order(NamedTuple):
    """A program to run; the descriptors sent with it are to have these numbers."""

    module: str
    arguments: Sequence[str]
    environment: dict[str, str]
    folder: str
    numbers: Sequence[int]
    is_safe: bool  # as by `python -P`: the folder is not on the path of modules
    has_session: bool


def standing() -> tuple[object, ...]:
    """Return what a child inherits besides what an order says."""
    limits = [getattr(resource, name) for name in dir(resource) if name.startswith("RLIMIT_")]
    return (
        os.getpid(),
        os.getresuid(),
        os.getresgid(),
        os.nice(0),
        os.sched_getscheduler(0),
        os.sched_getaffinity(0),
        [resource.getrlimit(limit) for limit in limits],
        [Path(f"/proc/self/ns/{name}").readlink() for name in ("mnt", "net", "pid", "user")],
    )


USUAL = standing()
ENVIRONMENT = build_environment()
ROOT = Path(__file__).parents[1]


class Stock:
    """The near end of a process that has a program's libraries."""

    def __init__(self, module: str) -> None:
        environment = dict(ENVIRONMENT)
        if module == COMMAND:
            # It is to find modules as a command of the user does.
            del environment["PYTHONPATH"]
        self._line, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._process = subprocess.Popen(
            [sys.executable, "-u", "-m", "tests.warm", str(theirs.fileno()), module],
            pass_fds=(theirs.fileno(),),
            stdin=subprocess.DEVNULL,
            cwd=ROOT,
            env=environment,
        )
        theirs.close()
        self.pid = self._process.pid
        self._lock = Lock()

    def start(self, order: Order, fds: Sequence[int]) -> int:
        """Start a program as a child of this process; return its process id."""
        with self._lock:
            # An orphan becomes the child of the next process above it that asks for orphans.
            _adopt_orphans(True)
            try:
                socket.send_fds(self._line, [pickle.dumps(order)], fds)
                return int(self._line.recv(MOST_BYTES))
            finally:
                _adopt_orphans(False)

    def close(self) -> None:
        """End it."""
        self._line.close()
        self._process.kill()
        self._process.wait()


STOCKS: dict[str, Stock] = {}
"""By module of the program."""


def fill() -> None:
    """Start the stocks of crates and recorders. The first command starts that of commands."""
    STOCKS.update({module: Stock(module) for module in (CRATE, RECORDER)})


def clear() -> None:
    """End the stocks."""
    while STOCKS:
        STOCKS.popitem()[1].close()


def programs(module: str) -> list[int]:
    """Return the children of this process that run a program, without its stock."""
    stocks = {stock.pid for stock in STOCKS.values()}
    return [
        pid
        for pid in list_children(os.getpid())
        if pid not in stocks and module.encode() in Path(f"/proc/{pid}/cmdline").read_bytes()
    ]


class Popen(subprocess.Popen[Any]):
    """`subprocess.Popen` for `python -m MODULE ...` with a MODULE that is in stock."""

    def _execute_child(self, *given: Any) -> None:
        order, fds = read_order(given)
        is_deaf = signal.SIG_IGN in map(signal.getsignal, SIGNALS)
        if standing() != USUAL or is_deaf or max(order.numbers) >= FIRST_FREE:
            super()._execute_child(*given)  # type: ignore[misc]
            return
        if order.module not in STOCKS:
            STOCKS[order.module] = Stock(order.module)
        self.pid = STOCKS[order.module].start(order, fds)
        self._child_created = True
        self._close_pipe_fds(*given[10:16])  # type: ignore[attr-defined]


class Fork(subprocess.Popen[Any]):
    """`subprocess.Popen` for `python -m MODULE ...` in a command, whose fork has the libraries."""

    def _execute_child(self, *given: Any) -> None:
        order, fds = read_order(given)
        before_start, process_group = given[2], given[22]
        self.pid = os.fork()
        if self.pid == 0:
            if process_group == 0:
                os.setpgid(0, 0)
            if before_start is not None:
                before_start()
            for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP}:
                # As by `exec`: what is handled is no longer, what is ignored still is.
                if signal.getsignal(number) not in (signal.SIG_IGN, signal.SIG_DFL, None):
                    signal.signal(number, signal.SIG_DFL)
            _take_over(order, fds)
            # What the command does at its own exit is not for this process to do.
            atexit._clear()
            # As by `python -u`: boards flush nothing at their end.
            _open_streams(is_unbuffered=True)
            run_and_exit(order)
        self._child_created = True
        self._close_pipe_fds(*given[10:16])  # type: ignore[attr-defined]


def read_order(given: Sequence[Any]) -> tuple[Order, list[int]]:
    """Return the order in the arguments of `_execute_child`, and its descriptors."""
    args, _, _, _, pass_fds, folder, environment, *_ = given
    words = [os.fspath(arg) for arg in args]
    begin = words.index("-m") + 1
    # The program's ends of stdin, stdout and stderr; -1 to inherit them.
    standard = (given[10], given[13], given[15])
    fds = [number if fd == -1 else fd for number, fd in enumerate(standard)]
    order = Order(
        words[begin],
        words[begin + 1 :],
        dict(os.environ if environment is None else environment),
        str(folder or Path.cwd()),
        [0, 1, 2, *pass_fds],
        "-P" in words[:begin],
        has_session=given[21],
    )
    return order, [*fds, *pass_fds]


def run_command(
    words: Sequence[str | Path], bound_s: float, **given: Any
) -> subprocess.CompletedProcess[Any]:
    """Run a command to its end, as `subprocess.run` does."""
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with Popen(words, **(pipes | given)) as process:
        try:
            out, err = process.communicate(timeout=bound_s)
        finally:
            process.kill()
    return subprocess.CompletedProcess(words, process.returncode, out, err)


subprocess_in_stock = SimpleNamespace(**{**vars(subprocess), "Popen": Popen})
"""What stands for the module `subprocess` where a rack's programs are started."""


def _adopt_orphans(adopts: bool) -> None:
    ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, int(adopts), 0, 0, 0)


def served(line: socket.socket) -> Order | None:
    """Fork a process for each order, until the other end is closed; in such a process, return what
    it is to run."""
    while True:
        data, fds, _, _ = socket.recv_fds(line, MOST_BYTES, MOST_FDS)
        if not data:
            return None
        reading, writing = os.pipe()
        starter = os.fork()
        if starter == 0:
            starter = os.getpid()
            if os.fork():
                os._exit(0)
            while os.getppid() == starter:
                os.sched_yield()
            os.write(writing, str(os.getpid()).encode())
            order: Order = pickle.loads(data)
            _take_over(order, fds)
            return order
        os.waitpid(starter, 0)
        for fd in (*fds, writing):
            os.close(fd)
        # Last: when the program ends, nothing else may hold its sockets open.
        line.send(os.read(reading, MOST_BYTES))
        os.close(reading)


def _take_over(order: Order, fds: Sequence[int]) -> None:
    """Be as the order's program is when it begins."""
    if order.has_session:
        os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    waiting = [fcntl.fcntl(fd, fcntl.F_DUPFD_CLOEXEC, FIRST_FREE) for fd in fds]
    os.closerange(3, FIRST_FREE)
    for fd, number in zip(waiting, order.numbers, strict=True):
        os.dup2(fd, number)
        os.close(fd)
    os.chdir(order.folder)
    os.environ.clear()
    os.environ.update(order.environment)
    sys.argv[1:] = order.arguments
    given = order.environment.get("PYTHONPATH", "").split(os.pathsep)
    path = dict.fromkeys(filter(None, [*given, *sys.path]))
    sys.path[:] = path if order.is_safe else [order.folder, *path]
    if order.module in (COMMAND, *LAUNCHERS):
        _open_streams(bool(order.environment.get("PYTHONUNBUFFERED")))
        for starter in (*STARTERS, other_racks):
            starter.subprocess = SimpleNamespace(**{**vars(subprocess), "Popen": Fork})


def _open_streams(is_unbuffered: bool) -> None:
    """Open the standard streams on the descriptors that there are now."""
    sys.stdin = os.fdopen(0, closefd=False)
    sys.stdout = os.fdopen(1, "w", closefd=False)
    sys.stdout.reconfigure(write_through=is_unbuffered)
    sys.stderr = os.fdopen(2, "w", buffering=1, errors="backslashreplace", closefd=False)


def run_and_exit(order: Order) -> NoReturn:
    """Run a program to its end, and end without freeing its libraries, which takes 0.1 s."""
    status: object = 1
    try:
        runpy.run_module(order.module, run_name="__main__", alter_sys=True)
        status = 0
    except SystemExit as end:
        status = end.code or 0
    except BaseException:
        traceback.print_exc()
    finally:
        if not isinstance(status, int):
            print(status, file=sys.stderr)  # noqa: T201  # as Python does
            status = 1
        atexit._run_exitfuncs()
        sys.stdout.flush()
        os._exit(status)


def load_levels() -> None:
    """Import the levels of NASREM, load their machine code and that for mailboxes, and compile the
    cell, which a crate otherwise does for each rack."""
    from rack.boards.config import load
    from rack.boards.crate.rack import build_preload_request
    from rack.boards.run.compiled_mailbox import load_machine_code
    from rack.levels.references import find_class
    from rack.levels.robot.cell import build_cell

    load_machine_code()
    nasrem = build_preload_request(load("nasrem"))
    for name in nasrem.classes:
        level: Any = find_class(name, object, in_child_first=False)
        level.preload()
    if (cell := nasrem.cell) is not None:
        build_cell(cell.robot, cell.scene, cell.clock_ns)


def main() -> None:
    """Keep a program in stock; the arguments are the descriptor of the line, and its module."""
    # Ctrl-C is for the tests.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    number, module = sys.argv[1:]
    for library in LIBRARIES[module]:
        importlib.import_module(library)
    if module != RECORDER:
        load_levels()
    if module == COMMAND:
        # `python -m` has put this folder there.
        sys.path.remove(str(ROOT))
    gc.freeze()
    if order := served(socket.socket(fileno=int(number))):
        if order.module in (COMMAND, *LAUNCHERS):
            run_and_exit(order)
        runpy.run_module(order.module, run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    main()
