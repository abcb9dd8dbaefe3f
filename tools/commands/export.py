"""`rack export`: write a recorded run as a file for other programs."""

from __future__ import annotations

import shutil
from importlib import import_module
from pathlib import Path
from typing import Literal, NamedTuple

from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, RunFolder, option
from rack.tools.console.progress import create_reading_progress
from rack.tools.recording.recording import Recording


class Exporter(NamedTuple):
    """A kind of file, and what writes it.

    Attributes:
        module: Module of the function.
        function: Function that writes the file and returns the number of its entries.
        name: Default name of the file in the folder of the run.
        entries: Word for the entries.
        extra: Extra that installs what the module needs.
    """

    module: str
    function: str
    name: str
    entries: str
    extra: str


EXPORTERS = {
    "mcap": Exporter("rosbag2", "export_mcap", "run.mcap", "messages", "export"),
    "rosbag2": Exporter("rosbag2", "export_bag", "run-rosbag2", "messages", "export"),
    "perfetto": Exporter("perfetto_trace", "export_trace", "run.pftrace", "slices", "perfetto"),
}


def export(
    run: RunFolder,
    to: Literal["mcap", "rosbag2", "perfetto"] = option("--to", "kind of the file", "mcap"),
    out: Path | None = option("--out FILE", "file or folder to write; default: in RUN"),
    as_json: Json = False,
) -> None:
    """Write a recorded run for Foxglove and PlotJuggler, for ROS 2, or for Perfetto.

    mcap: RUN/run.mcap, with the messages of the run as messages of ROS 2: joint states, poses,
    diagnostics, statuses, events, and each mailbox with a type of its own, whose definition is in
    the file. Time is simulated time.

    rosbag2: the folder RUN/run-rosbag2, with such a file and metadata.yaml, for ros2 bag. Both need
    rosbags: pip install 'nasrem-rack[export]'.

    perfetto: RUN/run.pftrace, with cycles, messages, misses and faults of boards and cores. Time is
    wall-clock time. It needs perfetto: pip install 'nasrem-rack[perfetto]'.

    Exit status: 0 written; 1 FILE cannot be written; 2 RUN is not a run or nothing is recorded in
    it, FILE exists, or a package is missing.

    \b
    Examples:
      rack export runs/nasrem-20250101-120000
      rack export runs/nasrem-20250101-120000 --to rosbag2 --out nasrem-bag
      rack export runs/nasrem-20250101-120000 --to perfetto --out nasrem.pftrace
    """
    exporter = EXPORTERS[to]
    try:
        module = import_module(f"rack.tools.ecosystem.{exporter.module}")
    except ImportError as error:
        package = str(error.name).partition(".")[0]
        install = f"pip install 'nasrem-rack[{exporter.extra}]'"
        raise Failure(f"--to {to} needs {package}: {install}", 2) from None
    recording = Recording(run)
    path = run / exporter.name if out is None else out
    if path.exists():
        raise Failure(f"{path}: exists already; remove it, or give another --out", 2)
    # Write into a temporary folder, so that nothing incomplete is left after Ctrl-C.
    partial = path.with_name(f"{path.name}.part")
    try:
        with INTERRUPT.raise_interrupted():
            partial.mkdir(exist_ok=True)
            write = getattr(module, exporter.function)
            progress = create_reading_progress(as_json, "exported")
            count = write(recording, partial / path.name, progress)
        (partial / path.name).rename(path)
    except OSError as error:
        if error.filename is not None:
            raise
        raise Failure(f"{path}: {error.strerror}") from None
    finally:
        shutil.rmtree(partial, ignore_errors=True)
    files = [path, *path.rglob("*")]
    size = sum(file.stat().st_size for file in files if file.is_file())
    document = {"file": str(path), exporter.entries: count, "bytes": size}
    text = f"{path}: {count:,} {exporter.entries}, {size * 1e-6:.1f} MB"
    print_answer(document, text, as_json)
