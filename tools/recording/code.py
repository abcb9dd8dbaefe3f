"""The code and the files with which a run was made: code.json in its folder.

A run is repeated by its own code alone. So the versions are recorded, and a digest of the program,
of each file of the user's levels, and of the model's folder.
"""

from __future__ import annotations

import json
import platform
import sys
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
    paths = {path for path in own if any(path.is_relative_to(p) for p in config.python_path)}
    if config.robot is not None:
        paths.add(config.robot.model.parent)
    names = ["version", "python", PROGRAM, *sorted(map(str, paths))]
    (folder / CODE).write_text(encode_json({name: _state_of(name) for name in names}) + "\n")


def check_code(recording: Recording, asked: str, anyway: bool) -> None:
    """Note on stderr what has changed since a run, if it is to be repeated `anyway`. Raises
    `Failure`, which begins with what was `asked`, if it is not."""
    path = recording.folder / CODE
    if not path.exists():
        why = f"it has no {CODE}: 'rack record' or an older version recorded it"
    else:
        recording.checksums.verify(CODE)
        recorded: dict[str, str] = json.loads(read_file(path))
        differ = [name for name, state in recorded.items() if _state_of(name) != state]
        if not differ:
            return
        shown = ", ".join("the code of rack" if name == PROGRAM else name for name in differ)
        why = f"since it was recorded, these have changed: {shown}"
    if not anyway:
        raise Failure(f"{asked}: {why}; --anyway continues it: digests may differ", 2)
    print(f"{asked}: {why}; digests may differ", file=sys.stderr)


def _state_of(name: str) -> str:
    """Return the version, or the digest, of what is named."""
    if name == "version":
        return version("nasrem-rack")
    if name == "python":
        return platform.python_version()
    paths = [path := Path(name)]
    if name == PROGRAM:
        floors = ("backplane", "levels", "boards")
        paths = [path for floor in floors for path in (FLOORS / floor).rglob("*.py")]
    elif path.is_dir():
        paths = [*path.rglob("*.xml")]
    digest = xxh3_128()
    for path in sorted(paths):
        # One that is gone has another digest.
        digest.update(path.name.encode() + (path.read_bytes() if path.is_file() else b""))
    return digest.hexdigest()
