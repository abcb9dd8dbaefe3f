"""Names of earlier versions in configs; modules of users that must not be imported."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rack.boards.config import CONFIGS, load, load_text, resolve_layout
from rack.boards.config.schema import RackConfig
from rack.levels.references import MOVED_REFERENCES, import_reference, resolve_moved
from tests.processes import BOUND_S, FORKS, children_of, descriptors

SYSTEMS = ("fig2", "nist-state-table", "rccl", "hic", "penn", "chimera", "cell/puma", "cell")


def use_old_names(config: RackConfig) -> tuple[RackConfig, list[str]]:
    """Return a config as a run of an earlier version saved it, and the old names in it."""
    text, used = config.to_toml_text(), []
    for old, new in MOVED_REFERENCES.items():
        if (
            changed := text.replace(f'"{new}:', f'"{old}:')
            if ":" not in old
            else text.replace(new, old)
        ) != text:
            text, used = changed, [*used, old]
    return load_text(text), used


def test_each_old_reference_resolves_to_an_existing_object() -> None:
    for old in MOVED_REFERENCES:
        module, name = import_reference(old if ":" in old else f"{old}:")
        assert not name or hasattr(module, name), old


def test_references_that_only_start_like_a_moved_one_are_unchanged() -> None:
    assert resolve_moved("rack.levels.handle:Grip") == "rack.levels.handle:Grip"
    assert resolve_moved("rack.levels.servo:ServoExecutor") == "rack.levels.servo:ServoExecutor"
    assert (
        resolve_moved("rack.levels.hand.workstation:Workstation")
        == "rack.levels.systems.hand.workstation:Workstation"
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_a_config_of_an_earlier_version_is_wired_like_a_present_one(name: str) -> None:
    config = load(CONFIGS / f"{name}.toml" if "/" in name else name)
    saved, used = use_old_names(config)
    assert used
    assert resolve_layout(saved) == resolve_layout(config)


ENDING = {
    "leaves": ("import os; os._exit(5)", "ImportError: it ended the process: exit status 5"),
    "leaves_well": ("import os; os._exit(0)", "ImportError: it ended the process: exit status 0"),
    "is_killed": (
        "import os; os.kill(os.getpid(), 9)",
        "ImportError: it ended the process: signal SIGKILL",
    ),
    "interrupts": ("raise KeyboardInterrupt", "ImportError: it ended the process: exit status 1"),
    "exits": ("raise SystemExit(7)", "SystemExit: 7"),
    "raises": ("1 / 0", "ZeroDivisionError: division by zero"),
    "loops": ("while True: pass", "ImportError: it did not finish within 0.5 s"),
}


@pytest.mark.slow
@pytest.mark.filterwarnings(FORKS)
@pytest.mark.parametrize("name", ENDING)
def test_a_module_cannot_end_or_block_the_process_that_checks_a_config(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
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
    done = subprocess.run(
        [sys.executable, "-u", "-c", "; ".join(lines)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=BOUND_S,
    )
    assert (done.stdout, done.stderr) == ("here\n", "")
