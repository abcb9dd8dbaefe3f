"""The code and the files with which a run was made: code.json in its folder.

A run is repeated by its own code alone. So the versions are recorded, and a digest of the program,
of each file of the user's levels, and of the model's folder.
"""

from __future__ import annotations

import json
import platform
import sys
from collections.abc import Iterator
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

from xxhash import xxh3_128

from rack.backplane.json_text import encode_json
from rack.boards.config.schema import RackConfig
from rack.tools.console.answer import Failure
from rack.tools.recording.checksums import read_file
from rack.tools.recording.recorder_process import CODE

if TYPE_CHECKING:
    from rack.tools.recording.recording import Recording

PROGRAM = "rack"
FLOORS = Path(__file__).resolve().parents[2]
"""The folder with the packages of the program."""


def write_code(config: RackConfig, folder: Path) -> None:
    """Write with what a run is made, after its levels have been loaded. Raises `OSError`."""
    files = [getattr(module, "__file__", None) for module in [*sys.modules.values()]]
    own = [Path(file) for file in files if file]
    paths = [path for path in own if any(path.is_relative_to(p) for p in config.python_path)]
    paths += [] if config.robot is None else [config.robot.model.parent]
    names = ["version", "python", PROGRAM, *map(str, sorted({*paths}))]
    states = {name: _state_of(name) for name in names}
    (folder / CODE).write_text(encode_json(states) + "\n")


def check_code(recording: Recording, asked: str, anyway: bool) -> Iterator[str]:
    """Yield what has changed since a run, as one line, if it is to be repeated `anyway`. Raises
    `Failure`, which begins with what was `asked`, if it is not."""
    path = recording.folder / CODE
    if not path.exists():
        why = f"it has no {CODE}: 'rack record' or an older version recorded it"
    else:
        recording.checksums.verify(CODE)
        recorded: dict[str, str] = json.loads(read_file(path))
        differ = [name for name, state in recorded.items() if _state_of(name) != state]
        why = f"since it was recorded, these have changed: {', '.join(differ)}" if differ else ""
    if why and not anyway:
        raise Failure(f"{asked}: {why}; --anyway continues it: digests may differ", 2)
    if why:
        yield f"{asked}: {why}; digests may differ"


def _state_of(name: str) -> str:
    """Return the version, or the digest, of what is named."""
    if name == "version":
        return version("nasrem-rack")
    if name == "python":
        return platform.python_version()
    if name == PROGRAM:
        floors = ("backplane", "levels", "boards")
        return _digest(path for floor in floors for path in (FLOORS / floor).rglob("*.py"))
    path = Path(name)
    return _digest(path.rglob("*.xml") if path.is_dir() else [path])


def _digest(paths: Iterator[Path] | list[Path]) -> str:
    found = xxh3_128()
    for path in sorted(paths):
        # One that is gone has another digest.
        found.update(path.name.encode() + (path.read_bytes() if path.is_file() else b""))
    return found.hexdigest()
