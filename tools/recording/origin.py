"""Where a run comes from: the run that it goes on from, origin.json in its folder, and the code and
the files with which it was made, code.json.

A run is repeated by its own code alone. So the versions are recorded, and a digest of the program,
of each file of the user's levels, and of the model's folder. Launching a run needs this, so it
imports nothing that reads recordings.
"""

from __future__ import annotations

import json
import platform
import sys
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Self

from xxhash import xxh3_128

from rack.backplane.json_text import encode_json
from rack.boards.config.schema import RackConfig
from rack.boards.events import CONTINUES
from rack.tools.console.answer import Document, Failure
from rack.tools.recording.checksums import read_file
from rack.tools.recording.file_names import CODE, ORIGIN

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
    `Failure`, which begins with what was `asked`, if it is not.
    """
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


@dataclass(frozen=True)
class Origin:
    """The run that another one goes on from before `tick`.

    `folder`: as its user named it. `launched_ns`: when it was launched, on the wall clock; no other
    run has that.
    """

    folder: str
    tick: int
    launched_ns: int

    @classmethod
    def at(cls, run: Recording, tick: int) -> Self:
        """Return it for what goes on from a run."""
        return cls(str(run.folder), tick, run.launch.created_ns)

    @classmethod
    def of(cls, recording: Recording) -> Self | None:
        """Return it for a recorded run; None for one that goes on from no other. Raises `Failure`
        for a damaged file.
        """
        path = recording.folder / ORIGIN
        if not path.exists():
            return None
        recording.checksums.verify(ORIGIN)
        return cls(**json.loads(read_file(path)))

    def is_of(self, run: Recording) -> bool:
        """Return whether it is this run, and no other one of that name."""
        return run.launch.created_ns == self.launched_ns

    def write(self, folder: Path) -> None:
        """Write it into the folder of the later run. Raises `OSError`."""
        (folder / ORIGIN).write_text(encode_json(asdict(self)) + "\n")

    def document(self, clock_ns: int) -> Document:
        """Return it as plain data, with its simulated time, s."""
        return {**asdict(self), "time_s": round(self.tick * clock_ns * 1e-9, 9)}


def continued_at(recording: Recording) -> int | None:
    """Return the tick before which a run that goes on from another begins; None for any other."""
    found = (event["tick"] for event in recording.events if event.get("code") == CONTINUES)
    return next(found, None)
