"""The origin of a run: the run that it continues, and the code and files that produced it.

A run can only be repeated with the same code. `code.json` therefore stores versions, and digests of
the program, of the user's levels and of the model's folder. `origin.json` identifies the run that
was continued. Launching a run imports this module, so it imports nothing that reads recordings.
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
from rack.tools.console.answer import Document, Failure
from rack.tools.recording.checksums import read_file
from rack.tools.recording.file_names import CODE, ORIGIN

if TYPE_CHECKING:
    from rack.tools.recording.recording import Recording

PROGRAM = "rack"
PACKAGES_FOLDER = Path(__file__).resolve().parents[2]
"""Folder that contains the packages of the program."""


def write_code_state(config: RackConfig, folder: Path) -> None:
    """Write code.json, which identifies the code that produces a run, into the run's folder.

    Call this after the levels have been loaded, because the code of the user's levels is found
    through the loaded modules.

    Raises:
        OSError: The file cannot be written.
    """
    files = [getattr(module, "__file__", None) for module in [*sys.modules.values()]]
    code_files = [Path(file) for file in files if file]
    paths = {path for path in code_files if any(path.is_relative_to(p) for p in config.python_path)}
    if config.robot is not None:
        paths.add(config.robot.model.parent)
    names = ["version", "python", PROGRAM, *sorted(map(str, paths))]
    (folder / CODE).write_text(encode_json({name: _compute_state(name) for name in names}) + "\n")


def check_code_state(recording: Recording, asked: str, anyway: bool) -> None:
    """Check that the code and files that produced a run have not changed since.

    Args:
        recording: The run.
        asked: Command line option or request that is named at the beginning of the message.
        anyway: Whether to print a warning on stderr instead of raising `Failure`.

    Raises:
        Failure: Code or files have changed, or code.json is missing, and `anyway` is False.
    """
    path = recording.folder / CODE
    if not path.exists():
        why = f"it has no {CODE}, because 'rack record' or an older version recorded it"
    else:
        recording.checksums.verify(CODE)
        recorded: dict[str, str] = json.loads(read_file(path))
        changed = [name for name, state in recorded.items() if _compute_state(name) != state]
        if not changed:
            return
        names = ", ".join("the code of rack" if name == PROGRAM else name for name in changed)
        why = f"since it was recorded, these have changed: {names}"
    if not anyway:
        raise Failure(f"{asked}: {why}; --anyway continues it, but digests may differ", 2)
    print(f"{asked}: {why}; digests may differ", file=sys.stderr)


def _compute_state(name: str) -> str:
    """Return the current value of an entry of code.json.

    Args:
        name: "version", "python", `PROGRAM`, or the path of a file or folder.

    Returns:
        The version for the first two, and a digest of the files for the others.
    """
    if name == "version":
        return version("nasrem-rack")
    if name == "python":
        return platform.python_version()
    paths = [path := Path(name)]
    if name == PROGRAM:
        floors = ("backplane", "levels", "boards")
        paths = [path for floor in floors for path in (PACKAGES_FOLDER / floor).rglob("*.py")]
    elif path.is_dir():
        paths = [*path.rglob("*.xml")]
    digest = xxh3_128()
    for path in sorted(paths):
        # The digest includes the name, so it also changes if a file is missing.
        digest.update(path.name.encode() + (path.read_bytes() if path.is_file() else b""))
    return digest.hexdigest()


@dataclass(frozen=True)
class Origin:
    """The original run of a continuation. A continuation begins at a tick of another run.

    Attributes:
        folder: Folder of the original run, as the user named it.
        tick: First tick of the continuation.
        launched_ns: Launch time of the original run on the wall clock, which identifies that run.
    """

    folder: str
    tick: int
    launched_ns: int

    @classmethod
    def read_from(cls, recording: Recording) -> Self | None:
        """Read the origin of a recorded run from its origin.json.

        Returns:
            The origin, or None if the run does not continue another one.

        Raises:
            Failure: origin.json is damaged.
        """
        path = recording.folder / ORIGIN
        if not path.exists():
            return None
        recording.checksums.verify(ORIGIN)
        return cls(**json.loads(read_file(path)))

    def write(self, folder: Path) -> None:
        """Write origin.json into the folder of the continuation. Raises `OSError`."""
        (folder / ORIGIN).write_text(encode_json(asdict(self)) + "\n")

    def to_document(self, clock_ns: int) -> Document:
        """Return the origin as plain data, with the simulated time of its tick in s."""
        return {**asdict(self), "time_s": round(self.tick * clock_ns * 1e-9, 9)}
