"""The command line of another checkout: it runs in its own environment."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

from rack.tools.console.answer import Failure
from rack.tools.lab.benches.checkout import checkout, this_rack
from tests.tools.command_line import BOUND_S, ROOT, rack

PROGRAM = """#!{python}
import os, sys

if "fail" in sys.argv:
    sys.exit("first line\\nthe reason")
if "wait" in sys.argv:
    sys.stdin.close()
    import threading
    threading.Event().wait()
print(sys.argv, os.environ.get("PYTHONPATH"))
"""


def tree_of(folder: Path) -> Path:
    """Make what looks like a checkout with its environment."""
    program = folder / ".venv" / "bin" / "rack"
    program.parent.mkdir(parents=True)
    program.write_text(PROGRAM.format(python=sys.executable))
    program.chmod(0o755)
    (folder / "pyproject.toml").touch()
    return folder


def test_a_checkout_runs_in_its_own_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(ROOT))
    other = checkout(tree_of(tmp_path / "other"))
    program = tmp_path / "other" / ".venv" / "bin" / "rack"
    assert other.run("run", 3, bound_s=BOUND_S) == f"['{program}', 'run', '3'] None\n"
    assert other.name == "other"


def test_this_tree_is_a_checkout_too() -> None:
    assert checkout(ROOT).run("--help", bound_s=BOUND_S) == this_rack().run(
        "--help", bound_s=BOUND_S
    )


@pytest.mark.slow
def test_a_command_that_fails_or_hangs_is_one_line(tmp_path: Path) -> None:
    other = checkout(tree_of(tmp_path / "other"))
    with pytest.raises(Failure, match=r"^other: rack fail now: the reason$"):
        other.run("fail", "now", bound_s=BOUND_S)
    with pytest.raises(Failure, match=r"^other: rack wait: still running after 0.5 s$"):
        other.run("wait", bound_s=0.5)


def test_a_path_that_is_no_checkout_is_refused_in_one_line(tmp_path: Path) -> None:
    bare = tmp_path / "bare"
    bare.mkdir()
    (bare / "pyproject.toml").touch()
    for tree, reason in (
        (tmp_path / "nowhere", "not a checkout of rack: no such folder"),
        (tmp_path, "not a checkout of rack: it has no pyproject.toml"),
        (bare, f"no environment; to make it: make -C {bare} .venv/installed"),
    ):
        with pytest.raises(Failure) as refused:
            checkout(tree)
        assert str(refused.value) == f"{tree}: {reason}"
        assert refused.value.status == 2


@pytest.mark.parametrize("bench", ["cycle", "lockstep"])
def test_a_bench_against_no_checkout_is_a_usage_error(bench: str, tmp_path: Path) -> None:
    done = rack("bench", bench, "--against", tmp_path / "nowhere", "--json")
    reason = f"{tmp_path / 'nowhere'}: not a checkout of rack: no such folder"
    assert (done.returncode, done.stderr.strip(), json.loads(done.stdout)["error"]) == (
        2,
        reason,
        [reason],
    )
