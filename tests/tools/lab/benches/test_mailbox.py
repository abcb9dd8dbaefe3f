"""The bench of mailboxes with real transports.

Every message is received as sent, nothing is left, and the best peer is the baseline.
"""

from __future__ import annotations

import os
import sys
import tempfile
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from rack.backplane.layout import PROTOCOLS
from rack.backplane.segment import SHM_FOLDER
from rack.tools.console.answer import Failure
from rack.tools.console.progress import Progress
from rack.tools.lab.benches.harness import INSTALL_COMMAND, Absent, Sample, find_missing_package
from rack.tools.lab.benches.mailbox import (
    BenchMessage,
    Case,
    build_comparison,
    build_exchange,
    measure_mailboxes,
)
from rack.tools.lab.benches.transports import PEERS, Peer, open_multiprocessing_pipe
from tests.processes import BOUND_S
from tests.tools.lab.benches.test_harness import Hidden

pytestmark = pytest.mark.thorough


def list_leftovers(pid: int) -> list[str]:
    return [path.name for path in SHM_FOLDER.iterdir() if str(pid) in path.name]


@pytest.mark.parametrize("peer", PEERS, ids=lambda peer: peer.name)
def test_every_reader_receives_every_message_and_nothing_is_left(
    peer: Peer, tmp_path: Path
) -> None:
    if find_missing_package(peer.name, peer.module):
        pytest.skip(f"{peer.module} is not installed")
    user = get_context("spawn").Process(target=exchange_messages, args=(peer, tmp_path))
    user.start()
    try:
        user.join(BOUND_S)
        assert user.exitcode == 0
    finally:
        user.kill()
    assert not list_leftovers(user.pid or 0)
    assert not list(tmp_path.iterdir())


def exchange_messages(peer: Peer, folder: Path) -> None:
    tempfile.tempdir = str(folder)
    case = Case("2 kB", 3)
    with peer.open_transport(
        BenchMessage.message_type.build_dtype(case.lengths), case.readers
    ) as transport:
        # No name is left even while messages pass.
        assert not list(folder.iterdir())
        assert not list_leftovers(os.getpid())
        for serial in range(1, 40):
            transport.message.id = serial
            transport.message.position[:] = np.arange(case.lengths["joints"]) + serial
            transport.send(serial)
            received = [read(serial) for read in transport.readers]
            sent = bytes(transport.message.raw)
            assert [bytes(message.raw) for message in received] == [sent] * 3
    assert not list(folder.iterdir())
    assert not list_leftovers(os.getpid())


def test_a_transport_that_loses_messages_is_noticed() -> None:
    lengths = Case("64 B", 2).lengths
    stale = BenchMessage.zeros(lengths)
    with open_multiprocessing_pipe(BenchMessage.message_type.build_dtype(lengths), 1) as transport:
        lossy = transport._replace(readers=[*transport.readers, lambda tick: stale])
        with pytest.raises(Failure, match=r"^lossy: a reader received another message"):
            build_exchange("lossy", lossy, lengths)


def test_the_baseline_of_a_case_is_its_best_peer() -> None:
    medians = {"time-slice": 3.0, "iceoryx2 blackboard": 5.0, "multiprocessing pipe": 4.0}
    samples = [Sample("64 B", who, (value,), "us") for who, value in medians.items()]
    samples += [Sample("200 B", "time-slice", (3.0,), "us")]
    found = build_comparison(samples, ())
    assert found.baselines == {"64 B": "multiprocessing pipe"}
    assert [found.compute_ratio(sample) for sample in samples] == [0.75, 1.25, 1.0, None]


def test_a_bench_measures_every_protocol_and_names_absent_contestants(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(sys, "meta_path", [Hidden("iceoryx2"), *sys.meta_path])
    for name in [name for name in sys.modules if name.partition(".")[0] == "iceoryx2"]:
        monkeypatch.delitem(sys.modules, name)
    cases = (Case("200 B", 1), Case("200 B", 4))
    found = measure_mailboxes(cases, 3, Progress())
    names = {"200 B, 1 reader", "200 B, 4 readers"}
    assert {sample.case for sample in found.samples} == set(found.baselines) == names
    assert {sample.who for sample in found.samples} >= {*PROTOCOLS, "multiprocessing pipe"}
    assert all(sample.count == 3 and sample.best > 0 for sample in found.samples)
    assert (
        Absent("iceoryx2 blackboard", "No module named 'iceoryx2'", INSTALL_COMMAND) in found.absent
    )
    assert set(found.baselines.values()) <= {peer.name for peer in PEERS}
    assert not list_leftovers(os.getpid())
