"""Experiments, and the folder that keeps what they found.

What an experiment found is kept as JSON with all that it depends on: the machine and the program,
of which its configs and its own settings are parts. It is made again only if one of these has
changed, or if it was not finished: a file appears whole or not at all, so even a killed command
continues where it was.
"""

from __future__ import annotations

import os
import platform
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Generic, TypeVar

import xxhash
from pydantic import TypeAdapter, ValidationError

from rack.backplane.errors import SegmentError
from rack.backplane.segment import racks
from rack.boards.config import load
from rack.boards.config.schema import RackConfig
from rack.boards.crate.clean import remove_dead
from rack.tools.console.answer import Failure, write_json
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.lab.benches.cyclictest import permits_fifo
from rack.tools.lab.benches.observed import UNVIEWED, Recorded, record

KEPT = "parts"
RUNS = "runs"
"""In the folder: results of experiments, and recordings of their runs."""
PROGRAM = Path(__file__).resolve().parents[4]
FLOORS = ("backplane", "levels", "boards", "tools", "configs")
RACK = "reproduce"
"""Prefix of the names of racks in shared memory."""
NO_FIFO = (
    "this machine refuses real-time priorities (SCHED_FIFO), so that an executor cannot preempt its"
    " planner"
)
LIBRARIES = ("mujoco", "numpy", "numba", "ompl", "ruckig")

Document = dict[str, Any]
Found = TypeVar("Found")


class Lacking(Failure):
    """The machine lacks what an experiment needs: its claims cannot be tested here, which is no
    failure.
    """


class Workshop:
    """The working folder of experiments, which holds the page.

    Attributes:
        folder: The folder, absolute.
        share: Whether racks may run on cores that another rack holds.
    """

    def __init__(self, folder: Path, share: bool) -> None:
        self.folder = folder.absolute()
        self.share = share

    @property
    def rack(self) -> str:
        """The name of its racks in shared memory: one runs at a time."""
        return f"{RACK}-{os.getpid()}"

    def prepare(self) -> None:
        """Make the folders, and remove racks that a killed command has left in shared memory."""
        for name in (KEPT, RUNS):
            (self.folder / name).mkdir(parents=True, exist_ok=True)
        for rack in racks():
            if rack.startswith(f"{RACK}-"):
                # That of a command which is running is in use.
                with suppress(SegmentError):
                    remove_dead(rack)

    def config(
        self, name: str, settings: Sequence[str] = (), faults: str | None = None
    ) -> RackConfig:
        """Return a config under the workshop's rack name, without a viewer's recording.

        Raises:
            ConfigError: The config is not valid.
        """
        return load(self.source(name), [*settings, *UNVIEWED, f"name={self.rack}"], faults)

    def source(self, name: str) -> str:
        """Return the config that an experiment loads for a name or a text.

        Tests override this to replace a rack by one that breaks a claim.
        """
        return name

    def run(self, label: str, config: RackConfig, seconds: float | None = None) -> Recorded:
        """Run a rack and return how it went and its recording, which stays in the folder; one of an
        unfinished run is replaced.
        """
        folder = self.folder / RUNS / label
        shutil.rmtree(folder, ignore_errors=True)
        return record(config, seconds, folder, self.share)


@dataclass(frozen=True, kw_only=True)
class Charted:
    """A record of which the page shows a chart in letters, or a table."""

    chart: str = ""


@dataclass(frozen=True)
class Experiment(Generic[Found]):
    """A measurement.

    Attributes:
        name: Its name, and the name of the file that keeps its result.
        about: Its description for the progress bar.
        seconds: About how long it takes.
        kind: Type of its record.
        measure: Runs it and returns the record. Raises `Failure`.
        cores: Number of processors needed for boards at real-time priorities. 0 if it does not need
            such priorities.
    """

    name: str
    about: str
    seconds: float
    kind: type[Found]
    measure: Callable[[Workshop], Found]
    cores: int = 1

    def make(self, workshop: Workshop) -> Found:
        """Return what is found. Raises `Lacking` on a machine that lacks what it needs."""
        if self.cores and not permits_fifo():
            raise Lacking(NO_FIFO)
        if (there := len(os.sched_getaffinity(0))) < self.cores:
            raise Lacking(f"it needs {self.cores} processors; this machine has {there}")
        return self.measure(workshop)

    def record(self, data: Any) -> Found:
        """Return what was found, from plain data."""
        return TypeAdapter(self.kind).validate_python(data)

    def document(self, found: Found) -> Any:
        """Return what was found as plain data."""
        return TypeAdapter(self.kind).dump_python(found, mode="json")


def depends() -> Document:
    """Return all that a result depends on, as it is now."""
    return {"program": program(), "machine": machine()}


@dataclass(frozen=True)
class Kept:
    """A result that is kept: what was found, when, in which time, and what it depends on; or why
    nothing can be found on this machine.
    """

    found: Any
    took_s: float
    made_at: str
    lacking: str = ""
    depends: Document = field(default_factory=dict)


def kept(experiment: Experiment[Any], folder: Path) -> Kept | None:
    """Return the result of an experiment if it is still right; None if it must be made."""
    try:
        text = (folder / KEPT / f"{experiment.name}.json").read_bytes()
        result = TypeAdapter(Kept).validate_json(text)
    except (OSError, ValidationError):
        return None
    return result if result.depends == depends() else None


def made(experiment: Experiment[Any], workshop: Workshop) -> Kept:
    """Make an experiment and keep its result. Raises `Failure` and what a rack raises."""
    started = time.monotonic()
    basis = depends()
    found: Any = None
    lacking = ""
    try:
        found = experiment.document(experiment.make(workshop))
    except Lacking as reason:
        lacking = str(reason)
    if INTERRUPT.number:
        # A signal ends a run in order, but before its time.
        INTERRUPT.end()
    took_s = round(time.monotonic() - started, 1)
    result = Kept(found, took_s, time.strftime("%Y-%m-%d %H:%M:%S"), lacking, basis)
    write_json(workshop.folder / KEPT / f"{experiment.name}.json", vars(result))
    return result


@cache
def machine() -> Document:
    """Return what the figures depend on in this machine."""
    cpu = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    model = next(
        (line.partition(":")[2].strip() for line in cpu if line.startswith("model name")),
        platform.machine(),
    )
    return {
        "processor": model,
        "cores": len(os.sched_getaffinity(0)),
        "kernel": platform.release(),
        "python": platform.python_version(),
        "real-time priorities": permits_fifo(),
        "libraries": ", ".join(f"{name} {version(name)}" for name in LIBRARIES),
    }


@cache
def program() -> str:
    """Return a checksum of the program and its configs."""
    digest = xxhash.xxh3_64()
    for path in program_files():
        digest.update(str(path.relative_to(PROGRAM)).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def program_files() -> Iterator[Path]:
    """Yield the files that results depend on, which leaves out the files that write the page."""
    page = Path(__file__).resolve().parents[1]
    for floor in FLOORS:
        for path in sorted((PROGRAM / floor).rglob("*.*")):
            is_source = path.suffix in (".py", ".toml", ".xml") and path.is_file()
            if is_source and path.parent != page:
                yield path
