"""Names of earlier versions in configs; modules of users that must not be imported."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rack.levels.references import import_reference
from tests.processes import BOUND_S, FORKS, children_of, descriptors

ENDED = "ImportError: it ended the process:"
ENDING = {
    "leaves": ("import os; os._exit(5)", f"{ENDED} exit status 5"),
    "leaves_well": ("import os; os._exit(0)", f"{ENDED} exit status 0"),
    "is_killed": ("import os; os.kill(os.getpid(), 9)", f"{ENDED} signal SIGKILL"),
    "interrupts": ("raise KeyboardInterrupt", f"{ENDED} exit status 1"),
    "exits": ("raise SystemExit(7)", "SystemExit: 7"),
    "raises": ("1 / 0", "ZeroDivisionError: division by zero"),
    "loops": ("while True: pass", "ImportError: it did not finish within 0.5 s"),
}


@pytest.mark.slow
@pytest.mark.filterwarnings(FORKS)
@pytest.mark.parametrize("name", ENDING)
def test_a_module_cannot_end_or_block_the_process_that_checks_a_config(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("rack.levels.references.SLOW_S", 0.2)
    monkeypatch.setattr("rack.levels.references.MAX_IMPORT_S", 0.5)
    monkeypatch.syspath_prepend(tmp_path)
    source, reason = ENDING[name]
    (tmp_path / f"it_{name}.py").write_text(source)
    children = children_of(os.getpid())
    before = descriptors()
    for _ in range(1 + (name == "loops")):
        with pytest.raises(LookupError) as error:
            import_reference(f"it_{name}:Level")
        assert str(error.value) == f"cannot import 'it_{name}': {reason}"
    assert children_of(os.getpid()) == children
    assert descriptors() == before
    # Once, though a config is checked for many mistakes.
    said = "still importing 'it_loops'; it may take 0.5 s\n" if name == "loops" else ""
    assert capfd.readouterr() == ("", said)


def test_output_of_an_imported_module_is_printed_once(tmp_path: Path) -> None:
    (tmp_path / "it_prints.py").write_text("print('here')")
    lines = [
        "import rack.levels.references as references",
        "references.SLOW_S = 60.0",
        "references.import_reference('it_prints:Level')",
    ]
    # Unbuffered, as in the processes of a rack.
    command = [sys.executable, "-u", "-c", "; ".join(lines)]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=BOUND_S)
    assert (done.stdout, done.stderr) == ("here\n", "")
