"""joined.json: predicted responses of a run along boards of several racks.

They depend on the configs of other racks, which may change or be unreachable later. A run therefore
stores them at its launch.
"""

from __future__ import annotations

from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import TypeAdapter

from rack.backplane.json_text import encode_json
from rack.boards.config.schema import RackConfig
from rack.boards.timing.joined import JoinedPath
from rack.tools.recording.file_names import JOINED

if TYPE_CHECKING:
    from rack.tools.recording.recording import Recording

JOINING = "rack.boards.config.joined"
"""Module that joins racks. Only racks with partners import it."""


def write_joined_paths(config: RackConfig, folder: Path) -> None:
    """Write joined.json into the folder of a run, if the config names other racks.

    Raises:
        ConfigError: The config of another rack has mistakes.
        OSError: The file cannot be written.
    """
    table = config.adapter.lan
    if table is None or not (table.launch or table.partners):
        return
    joining = import_module(JOINING)
    joined = joining.join_racks([config, *joining.load_partners(config)])
    paths = [asdict(path) for path in joined.list_paths(config.name)]
    (folder / JOINED).write_text(encode_json(paths) + "\n")


def read_joined_paths(recording: Recording) -> list[JoinedPath] | None:
    """Return the predicted responses that end in a recorded rack, or None if none were stored."""
    path = recording.folder / JOINED
    if not path.exists():
        return None
    recording.checksums.verify(JOINED)
    return TypeAdapter(list[JoinedPath]).validate_json(path.read_text())
