"""A checkpoint that is damaged, cut off or of another version is refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.boards.checkpoint.format import FOLDER, Checkpoint, PartState, checkpoints, read
from rack.boards.errors import CheckpointError


@pytest.fixture
def written(tmp_path: Path) -> tuple[Checkpoint, Path]:
    parts = {"clock": PartState("ab", b"state"), "wave": PartState("cd", b"")}
    found = Checkpoint(400, "layout", ((256, 3), (4096, 2)), b"abcde", parts)
    return found, found.write(tmp_path)


def test_a_checkpoint_is_read_as_it_was_written(written: tuple[Checkpoint, Path]) -> None:
    found, path = written
    assert read(path) == found
    assert path.name == "000000400.checkpoint"
    assert not list(path.parent.glob("*.unfinished"))


def test_every_changed_byte_and_every_cut_is_noticed(written: tuple[Checkpoint, Path]) -> None:
    _, path = written
    content = path.read_bytes()
    for at in range(len(content)):
        for damaged in (content[:at], content[:at] + bytes([content[at] ^ 4]) + content[at + 1 :]):
            path.write_bytes(damaged)
            # The size of the head is checked by what it leads to.
            with pytest.raises(CheckpointError, match=str(path)) as refused:
                read(path)
            assert "\n" not in str(refused.value)


def test_another_version_is_named(written: tuple[Checkpoint, Path]) -> None:
    _, path = written
    content = path.read_bytes()
    path.write_bytes(content[:8] + bytes([9]) + content[9:])
    with pytest.raises(CheckpointError, match="checkpoint version 9; this program reads 3"):
        read(path)


def test_the_checkpoints_of_a_run_are_found_in_their_order(
    written: tuple[Checkpoint, Path], tmp_path: Path
) -> None:
    found, path = written
    folder = tmp_path / "run" / FOLDER
    folder.mkdir(parents=True)
    (folder / "wave.state").touch()
    for tick in (1200, 400):
        path.rename(folder / f"{tick:09d}.checkpoint")
        path = found.write(tmp_path)
    assert list(checkpoints(tmp_path / "run")) == [400, 1200]
    assert not checkpoints(tmp_path)
