"""Does the campaign notice when a detector is gone? `python -m tests.mutants`: a step of its own in
CI.

Each mutant is a copy of the tree with one detector switched off. A small campaign in lockstep on it
must fail, and name the kind of fault that nobody finds any more; without any mutation the same
campaign must pass.
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

from tests.processes import RACK, run_to_end

ROOT = Path(__file__).resolve().parents[1]
COPIED = ("backplane", "boards", "configs", "levels", "tools")
SECONDS = "7"
"""Simulated time of each run: enough for a fault, its bound and its recovery."""
BOUND_S = 300
"""Time for one campaign; a mutant that has a rack wait for ever is stopped there."""


@dataclass(frozen=True)
class Mutant:
    """One detector switched off: `patches` are file, old text, new text. `kind` is what the
    campaign must name."""

    detector: str
    kind: str
    patches: tuple[tuple[str, str, str], ...]


def first(file: str, header: str, statement: str) -> tuple[str, str, str]:
    """Return the patch that has a method do nothing but `statement`."""
    return file, f"    {header}\n", f"    {header}\n        {statement}\n"


SLOTS, ARM = "backplane/mailbox/slots.py", "levels/arm/simulated.py"
MAILBOX, WATCH = "backplane/mailbox/mailbox.py", "backplane/watch"
MONITOR, RELEASED = "levels/servo/sensor_monitor.py", "backplane/clock/released_task.py"
DAMAGED = "self._episodes.record_finding(Alarm.DAMAGED, accesses, tick)"
REPORT = "def _report_silence(self, code: Alarm, tick: int, age: int) -> None:"
HANGS = "def _is_hanging(self, task: ReleasedTask) -> bool:"
GATE = "def refused(self, torque: Array) -> Finding | None:"
STEPS = "self.violations += int(steps.sum())"
MUTANTS = (
    Mutant(
        "sensor monitor",
        "sensor-bias",
        (first(MONITOR, "def _report_fault(self, finding: Finding) -> None:", "return"),),
    ),
    Mutant(
        "motor monitor",
        "actuator-off",
        (("levels/servo/actuator_monitor.py", "if not self._begun:", "if True:"),),
    ),
    Mutant(
        "checksum",
        "corrupt",
        (
            (SLOTS, "self.chain == xxh3(self.covered, self.words[_CHAIN])", "True"),
            ("boards/run/compiled_mailbox.py", " != check:", " is None:"),
            (f"{WATCH}/message_watch.py", "self._record_finding(Alarm.DAMAGED, tick)", "pass"),
            (f"{WATCH}/watched_reader.py", DAMAGED, "pass"),
        ),
    ),
    Mutant(
        "claim",
        "masquerade",
        (
            (MAILBOX, "if not slots.is_from_claimant(self._signature):", "if False:"),
            ("boards/run/ports.py", "if writer.intruder:", "if False:"),
        ),
    ),
    Mutant("silence", "mute", (first(f"{WATCH}/silence_watch.py", REPORT, "return"),)),
    Mutant("watchdog", "hang", (first(RELEASED, HANGS, "return False"),)),
    Mutant(
        "limit gate", "command-limit", (first("levels/arm/braked_arm.py", GATE, "return None"),)
    ),
    Mutant("brake", "sensor-nan", (first(ARM, "def brake(self) -> None:", "return"),)),
    Mutant(
        "restart",
        "kill",
        (("boards/crate/recovery.py", "if len(recent) >= max_restarts:", "if True:"),),
    ),
    Mutant(
        "violation counter",
        "violation counter",
        (("levels/arm/simulation.py", STEPS, "self.violations += 0"),),
    ),
)
KINDS = tuple(dict.fromkeys(m.kind for m in MUTANTS if m.kind != "violation counter"))


def mutated(
    folder: Path, patches: Sequence[tuple[str, str, str]], copied: Sequence[str] = COPIED
) -> None:
    """Copy the tree and patch it. Raises `LookupError` for a patch that applies no more."""
    for name in copied:
        shutil.copytree(
            ROOT / name, folder / "rack" / name, ignore=shutil.ignore_patterns("__pycache__")
        )
    # A package: it goes before that of the environment.
    (folder / "rack" / "__init__.py").touch()
    for file, old, new in patches:
        text = (folder / "rack" / file).read_text()
        if old not in text:
            raise LookupError(
                f"{file}: no longer holds {old.strip()!r}; mend the mutant in tests/mutants.py"
            )
        (folder / "rack" / file).write_text(text.replace(old, new))


def environment(folder: Path) -> dict[str, str]:
    """Return the environment in which a tree in `folder` runs. Code that is compiled for the copy
    goes with it."""
    return {**os.environ, "PYTHONPATH": str(folder), "XDG_CACHE_HOME": str(folder / "cache")}


def campaign(folder: Path, kinds: Sequence[str], core: int) -> tuple[int, str]:
    """Run a small campaign in a tree, on one core; return its exit status and what it has
    printed."""
    command = ["taskset", "-c", str(core), *RACK, "campaign", "nasrem", "--lockstep"]
    options = ["--injections", "1", "--sizes", "0", "--seed", "1", "--seconds", SECONDS]
    done = run_to_end(
        [*command, *options, "--kinds", ",".join(kinds), "--out", str(folder / "campaign")],
        BOUND_S,
        cwd=folder,
        env=environment(folder),
    )
    return done.returncode, done.stdout + done.stderr


def examined(mutant: Mutant | None, core: int) -> str:
    """Return what is wrong: the campaign did not notice the mutant, or None of it failed; empty
    when all is well."""
    kinds = [mutant.kind] if mutant is not None and mutant.kind in KINDS else KINDS
    with tempfile.TemporaryDirectory(prefix="mutant-") as folder:
        try:
            mutated(Path(folder), mutant.patches if mutant is not None else ())
        except LookupError as error:
            return str(error)
        status, text = campaign(Path(folder), kinds, core)
    if mutant is None:
        return "" if status == 0 else f"a campaign without any mutation fails:\n{text}"
    wanted = mutant.kind if mutant.kind not in KINDS else f"{mutant.kind} of "
    return (
        ""
        if status == 1 and wanted in text
        else f"status {status}, and no word of {mutant.kind}:\n{text}"
    )


def main() -> int:
    """Examine every mutant, as many at once as there are cores; return the exit status."""
    cores: SimpleQueue[int] = SimpleQueue()
    for core in os.sched_getaffinity(0):
        cores.put(core)

    def examine(mutant: Mutant | None) -> bool:
        core = cores.get()
        wrong = examined(mutant, core)
        cores.put(core)
        name, good = ("no mutation", "passed") if mutant is None else (mutant.detector, "noticed")
        print(f"{name}: {wrong or good}", flush=True)
        return not wrong

    wanted = sys.argv[1:]
    chosen = [m for m in (None, *MUTANTS) if not wanted or (m.detector if m else "none") in wanted]
    with ThreadPoolExecutor(cores.qsize()) as pool:
        return 0 if all(list(pool.map(examine, chosen))) else 1


if __name__ == "__main__":
    sys.exit(main())
