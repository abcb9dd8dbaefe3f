"""All processes of one contestant of `rack bench lan`: started, measured in windows, disturbed."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from multiprocessing import Pipe
from pathlib import Path
from subprocess import TimeoutExpired
from tempfile import TemporaryDirectory, TemporaryFile
from typing import Self

from rack.tools.console.answer import Failure
from rack.tools.lab.benches.harness import last_line
from rack.tools.lab.benches.lan_ends import COORDINATOR, LanTask, rack_name
from rack.tools.lab.benches.lan_machine import (
    ANSWER_S,
    FIND_S,
    TLS,
    LanFound,
    LanNotice,
    LanWindow,
)
from rack.tools.lab.benches.network import Lab

HEAD_START_NS = 300_000_000
"""Time from the order to measure to the first cycle."""
RUN = "from rack.tools.lab.benches.lan_machine import main; main()"
"""Not as a program: then its records would have other classes, those of `__main__`."""
REACT_S = 15.0
"""Longest wait for a death or a return to be seen."""


class Group:
    """The processes of one contestant, one on each machine of a lab. Raises `Failure` if one does
    not do its part.

    `false_deaths`: machines that the coordinator saw lost while nobody disturbed them.
    """

    def __init__(self, lab: Lab, who: str, echoes: bool, priority: int) -> None:
        self.lab = lab
        self.who = who
        self.racks = len(lab) - 1
        addresses = tuple(lab.address(machine) for machine in range(len(lab)))
        self._folder = TemporaryDirectory(prefix="rack-bench-")
        certificates = self._certificates(addresses) if who == TLS else ""
        self._tasks = [
            LanTask(who, machine, addresses, certificates, echoes, priority)
            for machine in range(len(lab))
        ]
        self._members: list[_Member] = []
        self.false_deaths = 0

    def _certificates(self, addresses: Sequence[str]) -> str:
        from rack.tools.network.certificates import make_credentials

        names = {rack_name(machine): [address] for machine, address in enumerate(addresses)}
        make_credentials(Path(self._folder.name), names, days=1)
        return self._folder.name

    def __enter__(self) -> Self:
        try:
            for task in self._tasks:
                self._members.append(_Member(self.lab, task))
            for member in self._members:
                member.found(FIND_S + len(self.lab))
        except BaseException:
            self._end()
            raise
        self._coordinator.notices.clear()
        return self

    def __exit__(self, *error: object) -> None:
        self._end()

    def _end(self) -> None:
        for member in self._members:
            member.end()
        self._folder.cleanup()

    @property
    def _coordinator(self) -> _Member:
        return self._members[COORDINATOR]

    def run(self, rate_hz: float, cycles: int) -> list[LanFound]:
        """Measure on all machines at a rate; return what each has found."""
        self.begin(rate_hz, cycles)
        bound_s = HEAD_START_NS * 1e-9 + (cycles + 1) / rate_hz + ANSWER_S + FIND_S
        found = [member.found(bound_s) for member in self._members]
        self._note_deaths()
        return found

    def begin(self, rate_hz: float, cycles: int) -> None:
        """Let all machines exchange at a rate, without waiting for their end."""
        window = LanWindow(time.monotonic_ns() + HEAD_START_NS, round(1e9 / rate_hz), cycles)
        for member in self._members:
            member.pipe.send(window)

    def idle(self, seconds: float) -> None:
        """Let so much time pass, in which nobody is to be lost."""
        self._coordinator.await_notice(lambda notice: False, seconds)
        self._note_deaths()

    def _note_deaths(self) -> None:
        self.false_deaths += sum(not notice.is_there for notice in self._coordinator.notices)
        self._coordinator.notices.clear()

    def pull_cable(self, machine: int) -> tuple[float, float]:
        """Pull a machine's cable until it is lost, then plug it in; return the times to see either,
        ms."""
        lost_ms = self._seen(machine, False, lambda: self.lab.unplug(machine))
        return lost_ms, self._seen(machine, True, lambda: self.lab.plug(machine))

    def kill(self, machine: int) -> float:
        """Kill a machine's process; return the time to see it, ms."""
        return self._seen(machine, False, self._members[machine].process.kill)

    def _seen(self, machine: int, is_there: bool, act: Callable[[], None]) -> float:
        start_ns = time.monotonic_ns()
        act()
        notice = self._coordinator.await_notice(
            lambda notice: (notice.machine, notice.is_there) == (machine, is_there), REACT_S
        )
        if notice is None:
            what = "back" if is_there else "lost"
            raise Failure(
                f"{self.who}: machine {machine} of {self.racks} is not seen {what} within"
                f" {REACT_S:g} s"
            )
        return (notice.seen_ns - start_ns) * 1e-6


class _Member:
    """One process of a group."""

    def __init__(self, lab: Lab, task: LanTask) -> None:
        self._name = f"{task.who}, machine {task.machine}"
        self._errors = TemporaryFile()  # noqa: SIM115  # closed when the process ends
        self.pipe, theirs = Pipe()
        self.notices: list[LanNotice] = []
        with theirs:
            argv = [sys.executable, "-c", RUN, str(theirs.fileno())]
            self.process = lab.popen(
                task.machine, argv, pass_fds=[theirs.fileno()], stderr=self._errors
            )
        self.pipe.send(task)

    def found(self, bound_s: float) -> LanFound:
        """Return what it has found. Notices that come before that are kept."""
        for answer in self._answers(bound_s):
            if isinstance(answer, LanFound):
                return answer
            self.notices.append(answer)
        raise Failure(f"{self._name}: no answer within {bound_s:g} s")

    def await_notice(self, is_it: Callable[[LanNotice], bool], bound_s: float) -> LanNotice | None:
        """Return the first notice that fits; None if there is none in time. Others are kept."""
        for answer in self._answers(bound_s):
            if isinstance(answer, LanNotice):
                if is_it(answer):
                    return answer
                self.notices.append(answer)
        return None

    def _answers(self, bound_s: float) -> Iterator[LanFound | LanNotice]:
        deadline = time.monotonic() + bound_s
        try:
            while self.pipe.poll(max(0.0, deadline - time.monotonic())):
                yield self.pipe.recv()
        except (EOFError, OSError):
            # The reason comes after the end of the pipe.
            with suppress(TimeoutExpired):
                self.process.wait(ANSWER_S)
            self._errors.seek(0)
            why = last_line(self._errors.read().decode(errors="replace"), "it says nothing")
            raise Failure(f"{self._name}: ended: {why}") from None

    def end(self) -> None:
        """Kill it."""
        self.process.kill()
        self.process.wait()
        self.pipe.close()
        self._errors.close()
