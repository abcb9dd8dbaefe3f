"""Several racks at once, for tests of the network: their configs, the racks as processes, and how
they ended.

As a program, `python -m tests.boards.lan.racks CONFIG SECONDS [KEY=VALUE]...` runs one rack and
prints its events and its outcome, one JSON document a line.
"""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any, NamedTuple

from rack.backplane.mailbox.protocols import open_observer
from rack.boards import Rack
from rack.boards.config import load
from rack.boards.config.schema import RackConfig
from rack.boards.crate.line import CrateLine
from rack.boards.errors import ConfigError, LaunchError
from rack.boards.events import Event, Outcome
from rack.tools.viewer.window import find_free_port
from tests.processes import BOUND_S

ROOT = Path(__file__).resolve().parents[3]
LAUNCH_S = 60.0
"""Bound of the launch of racks in processes of their own: on a loaded machine it takes 20 s."""


def rack_text(
    name: str,
    listen: str,
    connect: Iterable[str],
    other: str = "",
    *,
    peers: Iterable[str] = (),
    lan: str = "",
    insecure: bool | None = None,
) -> str:
    """Return the config of a rack that exports its pulse, and adds up that of rack `other`, if one
    is named.

    `lan`: further lines of its `[adapter.lan]`. `insecure`: by default where an endpoint needs it.
    """
    if insecure is None:
        insecure = any(end.startswith("tcp/") for end in (listen, *connect))
    if insecure:
        lan = f"insecure = true\n{lan}"
    text = f"""
format = 2
name = "{name}"
python_path = ["{Path(__file__).parent}"]

[clock]
period_ms = 2.5

[adapter.lan]
slot = 5
listen = {json.dumps([listen] if listen else [])}
connect = {json.dumps(list(connect))}
peers = {json.dumps(list(peers))}
export.pulse = {{ from = "pulse.status", rate_hz = 50 }}
{lan}

[board]
pulse = {{ slot = 2, rate_hz = 50, executor = "lan_levels:Pulse" }}
"""
    if not other:
        return text
    return f"""{text}echo = {{ slot = 3, rate_hz = 100, executor = "lan_levels:Echo" }}

[adapter.lan.import.other]
from = "{other}/pulse.status"
type = "lan_levels:PulseStatus"
rate_hz = 50
max_age_ms = 100
"""


def endpoints(count: int) -> list[str]:
    """Return endpoints on free ports of this machine's loopback."""
    return [f"tcp/127.0.0.1:{find_free_port()}" for _ in range(count)]


def ring_texts(names: Sequence[str]) -> list[str]:
    """Return the configs of racks that all know each other, each of which adds up the pulse of the
    one before it."""
    at, texts = endpoints(len(names)), []
    for k, name in enumerate(names):
        others = [other for other in names if other != name]
        texts.append(rack_text(name, at[k], at[:k], names[k - 1], peers=others))
    return texts


def configs(texts: Iterable[str], folder: Path, *settings: str) -> list[RackConfig]:
    found = []
    for k, text in enumerate(texts):
        path = folder / f"rack-{k}.toml"
        path.write_text(text)
        found.append(load(str(path), settings))
    return found


class Ended(NamedTuple):
    """A rack that has ended: its outcome, its events, and the last message of each mailbox, by name
    and field."""

    outcome: Outcome
    events: list[Event]
    last: dict[str, dict[str, Any]]

    @property
    def texts(self) -> str:
        """The texts of its events, a line each."""
        return "\n".join(event.text for event in self.events)


@contextmanager
def running(racks: Sequence[RackConfig]) -> Iterator[list[Rack]]:
    """Launch racks from this process, in this order; they begin when the caller starts them."""
    with ExitStack() as stack:
        # All crates import at once.
        crates = [stack.enter_context(CrateLine()) for _ in racks]
        yield [
            stack.enter_context(Rack(config, crate=crate))
            for config, crate in zip(racks, crates, strict=True)
        ]


def watch(racks: Sequence[Rack], until: Callable[[], object] = lambda: False) -> None:
    """Supervise racks until all have ended or `until` holds. Raises `TimeoutError` when neither
    comes."""
    deadline = time.monotonic() + BOUND_S
    while sum(rack.watch(0.005) for rack in racks) and not until():
        if time.monotonic() > deadline:
            raise TimeoutError(
                f"not within {BOUND_S:g} s: {[rack.events[-1].text for rack in racks]}"
            )


def run_together(racks: Sequence[RackConfig], seconds: Sequence[float | None]) -> list[Ended]:
    """Run racks from this process, launched in this order, until all have ended."""
    with running(racks) as launched:
        for rack, most in zip(launched, seconds, strict=True):
            rack.start(most)
        watch(launched)
        return [ended(rack) for rack in launched]


def ended(rack: Rack) -> Ended:
    """Return how a rack has ended, which is not closed yet."""
    assert rack.outcome is not None
    last = {}
    for box in rack.segment.layout.mailboxes:
        message = open_observer(rack.segment, box.name).peek().message
        last[box.name] = {name: getattr(message, name) for name in message.record.dtype.names}
    return Ended(rack.outcome, rack.events, last)


class RackProcess:
    """A rack in a process of its own, started by `popen`. `pid` is its launcher's.

    A thread takes its events as they come: on a busy machine it prints so many misses that the pipe
    would be full, and a launcher that waits for its reader restarts no board.
    """

    def __init__(
        self,
        config: Path,
        seconds: float | None,
        *settings: str,
        popen: Callable[..., subprocess.Popen[str]] = subprocess.Popen,
    ) -> None:
        command = [sys.executable, "-m", "tests.boards.lan.racks", str(config), str(seconds or 0)]
        command += settings
        self._process = popen(
            command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        self.pid = self._process.pid
        self.events: list[dict[str, Any]] = []
        self._unread: SimpleQueue[str | None] = SimpleQueue()
        self._reader = Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            self._unread.put(line)
        self._unread.put(None)

    def await_event(self, kind: str, text: str = "") -> dict[str, Any]:
        """Return the next event of a kind whose text contains this. Raises `AssertionError` if the
        rack ends first."""
        for event in self._lines():
            if event.get("kind") == kind and text in event["text"]:
                return event
        raise AssertionError(f"no event {kind} '{text}': {self.events} {self._errors()}")

    def outcome(self) -> dict[str, Any]:
        """Wait for its end and return its outcome, as in `Outcome`, or the text of the error of its
        launch."""
        for line in self._lines():
            if "kind" not in line:
                self._errors()
                return line
        raise AssertionError(f"no outcome: {self.events} {self._errors()}")

    def send(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def end(self) -> None:
        self._process.kill()
        self._errors()

    def _errors(self) -> str:
        """Wait for its end and return what it has printed on stderr."""
        self._reader.join(BOUND_S)
        return self._process.communicate(timeout=BOUND_S)[1]

    def _lines(self) -> Iterator[dict[str, Any]]:
        while (line := self._unread.get()) is not None:
            found = json.loads(line)
            self.events += [found] if "kind" in found else []
            yield found
        self._unread.put(None)


@contextmanager
def started(config: Path, seconds: float | None = None, *settings: str) -> Iterator[RackProcess]:
    """Start a rack in a process of its own, which is killed at the end, should it still run."""
    process = RackProcess(config, seconds, *settings)
    try:
        yield process
    finally:
        process.end()


def main(config: str, seconds: str, *settings: str) -> None:
    """Run one rack; a signal stops it as Ctrl-C would."""

    def show(document: dict[str, Any]) -> None:
        sys.stdout.write(json.dumps(document) + "\n")
        sys.stdout.flush()

    try:
        rack = Rack(load(config, list(settings)), lambda event: show(asdict(event)))
        signal.signal(signal.SIGTERM, lambda number, frame: rack.stop("SIGTERM received"))
        with rack:
            show(asdict(rack.run(float(seconds) or None)))
    except (ConfigError, LaunchError) as error:
        show({"error": str(error)})


if __name__ == "__main__":
    main(*sys.argv[1:])
