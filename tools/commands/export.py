"""`rack export`: write a recorded run as a file for other programs."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, RunFolder, option
from rack.tools.console.progress import create_reading_progress
from rack.tools.recording.recording import Recording


def export(
    run: RunFolder,
    to: Literal["mcap"] = option("--to", "kind of the file", "mcap"),
    out: Path | None = option("--out FILE", "file to write; default: RUN/run.mcap"),
    as_json: Json = False,
) -> None:
    """Write a recorded run as an MCAP file, which Foxglove and others read.

    Each mailbox becomes a channel of JSON messages, with units and meanings in its schema. Events
    become another channel. The log time is simulated time, the publish time is wall-clock time. The
    command needs mcap: pip install 'nasrem-rack[export]'.

    Exit status: 0 written; 1 FILE cannot be written, or mcap is missing; 2 RUN is not a run, or
    FILE exists.

    \b
    Examples:
      rack export runs/nasrem-20250101-120000
      rack export runs/nasrem-20250101-120000 --to mcap --out nasrem.mcap
    """
    try:
        from rack.tools.ecosystem import mcap_json
    except ImportError as error:
        if error.name is None or not error.name.startswith("mcap"):
            raise
        raise Failure(f"--to {to} needs mcap: pip install 'nasrem-rack[export]'") from None
    recording = Recording(run)
    path = run / "run.mcap" if out is None else out
    if path.exists():
        raise Failure(f"{path}: exists already; remove it, or give another --out", 2)
    # Write to a temporary file, so that no incomplete file is left after Ctrl-C.
    partial_file = path.with_name(f"{path.name}.part")
    try:
        with INTERRUPT.raise_interrupted():
            count = mcap_json.export_recording(
                recording, partial_file, create_reading_progress(as_json, "exported")
            )
        partial_file.rename(path)
    except OSError as error:
        if error.filename is not None:
            raise
        raise Failure(f"{path}: {error.strerror}") from None
    finally:
        partial_file.unlink(missing_ok=True)
    size = path.stat().st_size
    document = {"file": str(path), "messages": count, "bytes": size}
    print_answer(document, f"{path}: {count:,} messages, {size * 1e-6:.1f} MB", as_json)
