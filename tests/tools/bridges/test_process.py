"""Tests the process of a bridge beside a run, with a program in place of the bridge."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path

import pytest

from rack.tools.bridges import process

SILENT = "#!/bin/sh\necho open >&2\nexec sleep 600\n"


def test_a_run_never_waits_for_a_line_of_its_bridge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    program = tmp_path / "silent"
    program.write_text(SILENT)
    program.chmod(0o700)
    monkeypatch.setattr(sys, "executable", str(program))
    monkeypatch.setattr(process, "END_S", 0.0)
    with ExitStack() as stack:
        read_notices = process.start_bridge("ros2", "test", stack)
        assert read_notices() == ["ros2: open"]
        # Far more calls than a test has time for, if each waited.
        assert not any(read_notices() for _ in range(1000))
