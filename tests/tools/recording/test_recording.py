"""Damaged folders of runs: one line names the file and the damage.

Undamaged parts can still be read.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from rack.backplane.message import State
from rack.boards.config import load_text
from rack.tools.console.answer import Failure
from rack.tools.recording.checksums import Checksums, format_checked_line, parse_checked_line
from rack.tools.recording.parquet import HEAD_COLUMNS, create_signal_tables
from rack.tools.recording.recording import Recording
from rack.tools.recording.run_files import TABLE_PATTERNS
from rack.tools.report.analysis import Analysis
from rack.tools.report.report import write_report
from rack.tools.timing.charts.gantt import find_subject
from tests.tools.command_line import read_failure

READERS: tuple[Callable[[Path], object], ...] = (
    write_report,
    lambda folder: Analysis.from_recording(Recording(folder), 100.0, lambda done: None),
    lambda folder: find_subject(str(folder), [], None),
)
TABLE = "signals/lower.status.parquet"
PARQUET = ("cycles.parquet", f"{TABLE}/0001.parquet")
DAMAGES: dict[str, Callable[[Path], object]] = {
    "empty": lambda path: path.write_bytes(b""),
    "cut": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "binary": lambda path: path.write_bytes(bytes(range(256)) * 4),
    "missing": Path.unlink,
}


def assert_refused(folder: Path, name: str) -> None:
    """Check that every reader refuses the folder with one line that names the file."""
    for reader in READERS:
        assert name in read_failure(reader, folder)


@pytest.mark.parametrize("damage", DAMAGES)
@pytest.mark.parametrize("name", ["config.toml", *PARQUET])
def test_a_damaged_file_is_named(damaged: Path, name: str, damage: str) -> None:
    DAMAGES[damage](damaged / name)
    assert_refused(damaged, Path(name).name if damage == "missing" else name)


def test_a_config_cut_off_at_the_end_of_a_table_is_named(damaged: Path) -> None:
    path = damaged / "config.toml"
    whole = path.read_text()
    path.write_text(whole[: whole.rindex("\n[") + 1])
    # The truncated text is still a valid config.
    load_text(path.read_text())
    assert_refused(damaged, path.name)


def test_a_missing_part_is_reported_by_its_number(damaged: Path) -> None:
    part = damaged / PARQUET[1]
    part.rename(part.with_name("0002.parquet"))
    assert_refused(damaged, "0001.parquet: missing, but checksums.xxh128 lists it")


def messages(recording: Recording) -> dict[str, list[bytes]]:
    return {box.name: recording.read_rows(box.name).tolist() for box in recording.layout.timed}


def test_a_table_holds_the_columns_of_its_mailbox_and_their_units(run: Path) -> None:
    recording = Recording(run)
    table = pq.read_table(run / TABLE)
    fields = recording.list_fields("lower.status")
    assert table.column_names[:7] == ["time_s", *HEAD_COLUMNS]
    assert set(table.column_names[7:]) == fields
    assert table["tick"].to_pylist() == recording.read_signal("lower.status", "tick").tolist()
    assert table["time_s"].to_pylist() == pytest.approx(0.0025 * table["tick"].to_numpy())
    assert table.schema.field("time_s").metadata == {b"unit": b"s"}


@pytest.mark.slow
def test_a_field_named_like_a_column_of_every_mailbox_keeps_its_own_values(
    nasrem: Recording,
) -> None:
    box = nasrem.layout.find_mailbox("servo.state")
    rows = nasrem.read_rows(box.name)
    rows["message"]["tick"] += 7
    tables = create_signal_tables(nasrem.folder / "signals", nasrem.layout)
    tables[box.name].add_rows(rows)
    for table in tables.values():
        table.close()
    Checksums(nasrem.folder).store(*TABLE_PATTERNS)
    again = Recording(nasrem.folder)
    assert np.array_equal(again.read_rows(box.name)["message"], rows["message"])
    assert np.array_equal(
        again.read_signal(box.name, "tick") + 7, again.read_signal(box.name, "message.tick")
    )


@pytest.mark.slow
def test_a_long_run_has_many_parts_which_are_one_table(
    damaged: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recording = Recording(damaged)
    monkeypatch.setattr("rack.tools.recording.parquet.PART_ENTRIES", 1)
    monkeypatch.setattr("rack.tools.recording.parquet.MESSAGE_ROWS", 16)
    folder = tmp_path / "parts"
    folder.mkdir()
    for name in ("config.toml", "cycles.parquet"):
        shutil.copy(damaged / name, folder / name)
    # Files of a killed recorder are replaced.
    for _ in range(2):
        signals = create_signal_tables(folder / "signals", recording.layout)
        for box in recording.layout.timed:
            rows = recording.read_rows(box.name)
            for begin in range(0, len(rows), 16):
                signals[box.name].add_rows(rows[begin : begin + 16])
        for table in signals.values():
            table.close()
    Checksums(folder).store("config.toml", *TABLE_PATTERNS)
    assert len([*(folder / TABLE).iterdir()]) > 10
    again = Recording(folder)
    assert messages(again) == messages(recording)
    ticks = [pq.read_table(each / TABLE)["tick"].to_pylist() for each in (damaged, folder)]
    assert ticks[0] == ticks[1]


NO_EVENTS = (bytes(range(256)), b'{"kind": 3}\n', b"[]\n", b'{"kind": "outcome", "outcome": 1}\n')


@pytest.mark.parametrize("text", NO_EVENTS)
def test_lines_that_are_no_events_are_reported_with_their_number(
    damaged: Path, text: bytes
) -> None:
    (damaged / "events.jsonl").write_bytes(text)
    why = r"events\.jsonl: (line 1: not an event|not readable as a recording: .*byte 0x80)"
    with pytest.raises(Failure, match=why):
        write_report(damaged)


def test_an_event_that_was_reported_late_is_sorted_by_tick(damaged: Path) -> None:
    path = damaged / "events.jsonl"
    *lines, outcome = path.read_text().splitlines(keepends=True)
    late = parse_checked_line(lines[-1]) | {"tick": 7, "code": "late"}
    path.write_text("".join([*lines, format_checked_line(late), outcome]))
    events = Recording(damaged).events
    ticks = [event["tick"] for event in events[:-1]]
    assert late in events
    assert ticks == sorted(ticks)
    assert events[-1] == parse_checked_line(outcome)


def test_an_incomplete_last_line_is_left_out_with_a_note(
    damaged: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = damaged / "events.jsonl"
    lines = path.read_text().splitlines()
    path.write_text("\n".join([*lines, lines[0][:20]]))
    assert Recording(damaged).events == [parse_checked_line(line) for line in lines]
    assert f"{path}: line {len(lines) + 1} is cut off, and left out" in capsys.readouterr().err


def test_a_reason_cannot_command_the_terminal_that_shows_a_report(damaged: Path) -> None:
    file = damaged / TABLE / "0001.parquet"
    table = pq.read_table(file)
    for name, value in (("state", State.HOLDING), ("reason", "\x1b[2J")):
        column = table.schema.field(name)
        values = pa.array([value] * len(table), column.type)
        table = table.set_column(table.schema.get_field_index(name), column, values)
    pq.write_table(table, file)
    Checksums(damaged).store(*TABLE_PATTERNS)
    _, text = write_report(damaged)
    assert "\x1b" not in text
    assert r"\x1b[2J" in text
