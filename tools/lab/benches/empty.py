"""Boards that compute nothing: each reads a message of 8 bytes and writes one. What is left is the
rack's own cost."""

from __future__ import annotations

from pathlib import Path

BOARDS = 6
"""As many as a rack of four levels, a world model and a loose planner has."""
LEVEL = '''\
"""A level with an empty cycle."""

from {package}backplane.message import Field, MessageType
from {package}levels.level import Executor, Input, Ports

NUMBER = MessageType("number", 1, (Field("number", "i8", "1", "nothing in particular"),))


class Empty(Executor):
    """Reads a message, writes one, and processes nothing."""

    inputs = {{"read": Input(NUMBER, "below.written")}}
    outputs = {{"written": NUMBER}}

    def process(self, read: Ports, write: Ports, tick: int) -> None:
        """Process nothing."""
'''
HEAD = """\
name = "empty"
python_path = ["."]

[clock]
period_ms = 2.5
core = 0
priority = 90
"""
BOARD = """
[board.b{number}]
slot = {slot}
core = {core}
rate_hz = 400
executor = "{module}:Empty"
priority = 80
reads = {{ read = "b{before}.written" }}
"""


def write_empty_rack(folder: Path, package: str, boards: int = BOARDS) -> Path:
    """Write a rack of so many boards in a ring, on two cores by turns, and its level into a folder;
    return its config.

    `package` is what imports of rack begin with, "rack." or nothing.
    """
    module = "empty_level"
    (folder / f"{module}.py").write_text(LEVEL.format(package=package))
    tables = [
        BOARD.format(number=at, slot=2 + at, core=at % 2, module=module, before=(at - 1) % boards)
        for at in range(boards)
    ]
    path = folder / "empty.toml"
    path.write_text(HEAD + "".join(tables))
    return path
