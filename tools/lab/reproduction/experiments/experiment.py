"""Experiments, and the folder that stores their results.

A result is stored as JSON together with everything on which it depends: the machine, and the
program including its configs and settings. An experiment is repeated only if one of these has
changed or if it was not finished. A file is written completely or not at all. A command that was
killed therefore continues with the first missing experiment.
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
from rack.backplane.segment import list_racks
from rack.boards.config import load
from rack.boards.config.schema import RackConfig
from rack.boards.crate.clean import remove_dead_rack
from rack.tools.console.answer import Failure, write_json
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.lab.benches.cyclictest import is_fifo_permitted
from rack.tools.lab.benches.observed import UNVIEWED_SETTINGS, ObservedRun, record_rack

# Subfolders for the results of experiments and for the recordings of their runs.
RESULTS_FOLDER = "parts"
RUNS_FOLDER = "runs"
PROGRAM = Path(__file__).resolve().parents[4]
PRODUCT_FOLDERS = ("backplane", "levels", "boards", "tools", "configs")
RACK_PREFIX = "reproduce"
"""Prefix of the names of racks in shared memory."""
NO_FIFO_REASON = (
    "this machine refuses real-time priorities (SCHED_FIFO); without them an executor cannot"
    " preempt its planner"
)
LIBRARIES = ("mujoco", "numpy", "numba", "ompl", "ruckig")

Document = dict[str, Any]
Found = TypeVar("Found")


class RequirementMissing(Failure):
    """Raised if this machine lacks something that an experiment needs.

    The claims of the experiment are then untestable, which is not a failure.
    """


class Workshop:
    """Working folder of experiments, which also contains the page.

    Attributes:
        folder: Absolute path of the folder.
        share: Whether racks may run on cores that another rack uses.
    """

    def __init__(self, folder: Path, share: bool) -> None:
        self.folder = folder.absolute()
        self.share = share

    @property
    def rack(self) -> str:
        """Name in shared memory of all racks of the experiments, which run one at a time."""
        return f"{RACK_PREFIX}_{os.getpid()}"

    def prepare(self) -> None:
        """Create the folders, and remove racks that a killed command left in shared memory."""
        for name in (RESULTS_FOLDER, RUNS_FOLDER):
            (self.folder / name).mkdir(parents=True, exist_ok=True)
        for rack in list_racks():
            if rack.startswith(f"{RACK_PREFIX}_"):
                # The rack of a running command is in use and cannot be removed.
                with suppress(SegmentError):
                    remove_dead_rack(rack)

    def load_config(
        self, name: str, settings: Sequence[str] = (), faults: str | None = None
    ) -> RackConfig:
        """Load a config under the workshop's rack name, without a recording for the viewer.

        Args:
            name: Name or text of the config.
            settings: Changes to the config, as for `--set`.
            faults: Name or path of a fault script. None for no script.

        Raises:
            ConfigError: If the config is not valid.
        """
        return load(
            self.find_source(name), [*settings, *UNVIEWED_SETTINGS, f"name={self.rack}"], faults
        )

    def find_source(self, name: str) -> str:
        """Return the config that is loaded for a name or a text.

        Tests override this method to substitute a rack that violates a claim.
        """
        return name

    def run(self, label: str, config: RackConfig, seconds: float | None = None) -> ObservedRun:
        """Run a rack and record it in the folder.

        A recording of an earlier run with this label is replaced.

        Args:
            label: Name of the recording.
            config: Rack to run.
            seconds: Time of the run, s. None to run until a board ends it.
        """
        folder = self.folder / RUNS_FOLDER / label
        shutil.rmtree(folder, ignore_errors=True)
        return record_rack(config, seconds, folder, self.share)


@dataclass(frozen=True, kw_only=True)
class ChartedRecord:
    """Record with a chart in letters, or a table, for the page."""

    chart: str = ""


@dataclass(frozen=True)
class Experiment(Generic[Found]):
    """A measurement for the page.

    Attributes:
        name: Name of the experiment and of the file that stores its result.
        about: Description for the progress bar.
        seconds: Approximate time that it takes, s.
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

    def measure_if_possible(self, workshop: Workshop) -> Found:
        """Run the experiment. Raises `RequirementMissing` if this machine cannot run it."""
        if self.cores and not is_fifo_permitted():
            raise RequirementMissing(NO_FIFO_REASON)
        if (available := len(os.sched_getaffinity(0))) < self.cores:
            raise RequirementMissing(
                f"it needs {self.cores} processors; this machine has {available}"
            )
        return self.measure(workshop)

    def parse_record(self, data: Any) -> Found:
        """Convert plain data to a record."""
        return TypeAdapter(self.kind).validate_python(data)

    def to_document(self, record: Found) -> Any:
        """Convert a record to plain data."""
        return TypeAdapter(self.kind).dump_python(record, mode="json")


def describe_dependencies() -> Document:
    """Return the properties of the program and the machine on which results depend."""
    return {"program": compute_program_checksum(), "machine": describe_machine()}


@dataclass(frozen=True)
class StoredResult:
    """A stored result of an experiment.

    Attributes:
        found: The record as plain data.
        took_s: Time that the experiment took, s.
        made_at: Local time at which it was finished.
        lacking: Reason why this machine cannot run the experiment. Empty if it can.
        depends: Everything on which the result depends.
    """

    found: Any
    took_s: float
    made_at: str
    lacking: str = ""
    depends: Document = field(default_factory=dict)


def load_result(experiment: Experiment[Any], folder: Path) -> StoredResult | None:
    """Return the stored result of an experiment. None if it is missing or no longer valid."""
    try:
        text = (folder / RESULTS_FOLDER / f"{experiment.name}.json").read_bytes()
        result = TypeAdapter(StoredResult).validate_json(text)
    except (OSError, ValidationError):
        return None
    return result if result.depends == describe_dependencies() else None


def run_and_store(experiment: Experiment[Any], workshop: Workshop) -> StoredResult:
    """Run an experiment and store its result. Raises `Failure` and the exceptions of a rack."""
    start_s = time.monotonic()
    dependencies = describe_dependencies()
    data: Any = None
    missing = ""
    try:
        data = experiment.to_document(experiment.measure_if_possible(workshop))
    except RequirementMissing as reason:
        missing = str(reason)
    if INTERRUPT.number:
        # The signal ended the run cleanly, but too early for a valid result.
        INTERRUPT.end_process()
    took_s = round(time.monotonic() - start_s, 1)
    result = StoredResult(data, took_s, time.strftime("%Y-%m-%d %H:%M:%S"), missing, dependencies)
    write_json(workshop.folder / RESULTS_FOLDER / f"{experiment.name}.json", vars(result))
    return result


@cache
def describe_machine() -> Document:
    """Describe the properties of this machine that affect the measurements."""
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
        "real-time priorities": is_fifo_permitted(),
        "libraries": ", ".join(f"{name} {version(name)}" for name in LIBRARIES),
    }


@cache
def compute_program_checksum() -> str:
    """Return a checksum of the program and its configs."""
    digest = xxhash.xxh3_64()
    for path in list_program_files():
        digest.update(str(path.relative_to(PROGRAM)).encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()


def list_program_files() -> Iterator[Path]:
    """Yield the files on which results depend. The modules that write the page are left out."""
    page = Path(__file__).resolve().parents[1]
    for floor in PRODUCT_FOLDERS:
        for path in sorted((PROGRAM / floor).rglob("*.*")):
            is_source = path.suffix in (".py", ".toml", ".xml") and path.is_file()
            if is_source and path.parent != page:
                yield path
