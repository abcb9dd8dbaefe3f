"""The command line of another checkout runs in the environment of that checkout."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from rack.tools.console.answer import Failure
from rack.tools.lab.benches.checkout import RackCommand, build_checkout_command, build_rack_commands
from tests.tools.command_line import BOUND_S, ROOT, read_failure

PYTHON = """#!/bin/sh
[ -z "$PYTHONPATH$VIRTUAL_ENV" ] || exit 9
case "$2" in
*parents*) echo {tree} ;;
*) [ "$3" = fail ] && {{ printf 'first line\\nthe reason\\n' >&2; exit 1; }}; echo "own $3 $4" ;;
esac
"""


def create_tree(folder: Path, of: Path) -> Path:
    """Create a checkout whose environment claims to belong to the tree `of`."""
    (folder / "tools").mkdir(parents=True)
    (folder / "tools" / "cli.py").touch()
    (folder / ".venv" / "bin").mkdir(parents=True)
    python = folder / ".venv" / "bin" / "python"
    python.write_text(PYTHON.format(tree=of))
    python.chmod(0o755)
    return folder


def test_a_checkout_runs_in_its_own_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    monkeypatch.setenv("VIRTUAL_ENV", str(tmp_path))
    this, other = build_rack_commands(create_tree(tmp_path / "other", tmp_path / "other"))
    assert (this.name, other.name) == ("this tree", "other")
    assert other.run("run", 3, bound_s=BOUND_S) == "own run 3\n"
    assert "Usage: rack" in this.run("--help", bound_s=BOUND_S)
    with pytest.raises(Failure, match=r"^other: rack fail now: the reason$"):
        other.run("fail", "now", bound_s=BOUND_S)


@pytest.mark.slow
def test_a_command_that_hangs_is_ended() -> None:
    waits = "import threading; threading.Event().wait()"
    command = RackCommand("other", (sys.executable, "-c", waits))
    with pytest.raises(Failure, match=r"^other: rack wait: still running after 0.5 s$"):
        command.run("wait", bound_s=0.5)


def test_a_tree_without_a_separate_environment_is_refused_in_one_line(tmp_path: Path) -> None:
    bare = create_tree(tmp_path / "bare", tmp_path)
    (bare / ".venv" / "bin" / "python").unlink()
    mistakes = {
        tmp_path / "nowhere": "is not a checkout of rack: it has no tools/cli.py",
        bare: f"has no environment .venv; to create it: make -C {bare} .venv/installed",
        create_tree(tmp_path / "copied", ROOT): f"its .venv belongs to {ROOT}; to renew it: make",
    }
    for tree, reason in mistakes.items():
        assert read_failure(build_checkout_command, tree).startswith(f"{tree}: {reason}")
