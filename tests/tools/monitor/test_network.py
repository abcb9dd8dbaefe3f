"""Tests the view of the network: other racks and exchanged messages, live and in a report."""

from __future__ import annotations

from io import StringIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from rich.console import Console

from rack.backplane.mailbox.history import build_row_dtype
from rack.backplane.mailbox.protocols import open_writer
from rack.boards.config import resolve_layout
from rack.boards.config.loader import load_text
from rack.levels.peer import Presence
from rack.tools.monitor.display import RackView
from rack.tools.monitor.network import (
    ExportRow,
    ImportRow,
    PeerRow,
    list_exports,
    list_imports,
    list_peers,
    read_entries,
)
from rack.tools.monitor.newest_messages import NewestMessages
from rack.tools.monitor.snapshot import RackMonitor
from rack.tools.report.report import summarize_network
from tests.boards.lan.racks import rack_text
from tests.tools.conftest import MakeSegment
from tests.tools.recordings import recorded

TEXT = rack_text(
    "one", "tcp/127.0.0.1:7447", [], "other-one", peers=["third"], lan='on_peer_loss = "go on"'
)
COUNTS = {
    "taken": 7,
    "missing": 1,
    "disordered": 1,
    "repeated": 2,
    "late": 3,
    "refused": 4,
    "unknown_launch": 5,
    "superseded": 6,
}


def test_a_running_rack_shows_peers_imports_and_exports(
    rack_name: str, make_segment: MakeSegment
) -> None:
    segment = make_segment(load_text(TEXT.replace('name = "one"', f'name = "{rack_name}"')))
    status, peer = open_writer(segment, "lan.status"), open_writer(segment, "lan.peer_other_one")
    status.message.import_other[...] = (*COUNTS.values(), 99, 40, 80, 16, 0.04, 0.5)
    status.message.export_pulse[...] = (12, 24)
    status.write(8)
    found = peer.message
    found.presence, found.launches, found.losses, found.since = Presence.LOST, 2, 1, 400
    found.offset, found.uncertainty = -0.5, 0.0002
    peer.write(8)
    newest = NewestMessages(segment)
    assert [*list_peers(newest)] == [PeerRow("other-one", "lost", 400, 2, 1, -500.0, 0.2)]
    taken = ImportRow(
        "lan.other", "other-one/pulse.status", *COUNTS.values(), age_ticks=16, age_s=0.04
    )
    assert [*list_imports(newest)] == [taken]
    assert [*list_exports(newest)] == [ExportRow("lan.pulse", "pulse.status", 12)]
    terminal = Console(width=200, record=True, file=StringIO())
    terminal.print(RackView(RackMonitor(segment).take_snapshot()))
    text = terminal.export_text()
    shown = ("other-one  lost", "lan.other  other-one/pulse.status", "lan.pulse  pulse.status")
    assert [part for part in (*shown, "16  0.040") if part not in text] == []
    assert not any(read_entries('name = "alone"'))


def test_a_report_has_counts_ages_and_losses(tmp_path: Path) -> None:
    config = load_text(TEXT)
    layout = resolve_layout(config)
    rows = {
        name: np.zeros(3, build_row_dtype(layout.find_mailbox(name)))
        for name in ("lan.status", "lan.peer_other_one", "lan.peer_third")
    }
    status, peer = (rows[name]["message"] for name in ("lan.status", "lan.peer_other_one"))
    status["import_other"]["age_s"] = [-1.0, 0.02, 0.04]
    status["export_pulse"]["sent"] = [0, 1, 2]
    for name, count in COUNTS.items():
        status["import_other"][name][2] = count
    peer["presence"], peer["launches"], peer["losses"] = [1, 2, 2], [1, 1, 2], [0, 1, 1]
    found = summarize_network(recorded(tmp_path / "run", config, {}, messages=rows))
    assert found is not None
    (entry,) = found["imports"]
    assert {name: entry[name] for name in COUNTS} == COUNTS
    assert (entry["age_ms"]["p50"], entry["age_ms"]["max"]) == (30.0, 40.0)
    assert found["peers"] == [
        {"peer": "other-one", "state": "lost", "losses": 1, "restarts": 1, "lost_s": 0.04},
        {"peer": "third", "state": "awaited", "losses": 0, "restarts": 0, "lost_s": 0.0},
    ]
    assert summarize_network(SimpleNamespace(config='name = "alone"', mailboxes=())) is None  # type: ignore[arg-type]
