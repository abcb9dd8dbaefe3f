"""The summary of a run: at most 25 lines of 80 columns, with the verdict first."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from rack.tools.launch.verdict import UNRECORDED
from rack.tools.recording.cores import CoreRecord, Stolen
from rack.tools.report.report import build_report, write_report
from rack.tools.report.summary import MAX_LINES, WIDTH, format_run_summary, show_summary
from tests.shared_runs import faulty_run, nasrem_run, run_text
from tests.tools.command_line import rack
from tests.tools.conftest import Record
from tests.tools.recording.test_stalls import (
    MISSED,
    OTHER,
    PLAIN,
    SETTLED,
    absence_trace,
    plain_cycles,
    skipping,
)
from tests.tools.recording.test_stalls import (
    run as run_stalled,
)
from tests.tools.recordings import MS, Cycle

Document = dict[str, Any]


def summary(document: Document, width: int = WIDTH) -> list[str]:
    """Return the lines of a summary, which keeps to its size."""
    lines = format_run_summary(document, width)
    folds = -(-WIDTH // width)
    assert len(lines) <= MAX_LINES * folds
    commands = ("rack report ", "rack replay ", "rack analyze ", str(document["folder"]))
    wide = [line for line in lines if len(line) > width and not any(c in line for c in commands)]
    assert not wide
    assert lines[0].startswith(f"{document['rack']}: ")
    return lines


def flat(lines: list[str]) -> str:
    return " ".join(" ".join(lines).split())


@pytest.fixture(scope="module")
def small_report(run: Path) -> Document:
    return write_report(run)[0]


def armless_run(factory: pytest.TempPathFactory) -> Path:
    return run_text(factory, 'format = 2\nextends = ["fig2"]\n', 0.5, "clock.mode=lockstep")


RUNS: dict[Callable[[pytest.TempPathFactory], Path], tuple[str, tuple[str, ...]]] = {
    nasrem_run: (
        "TIME OVER after 6.5 s (lockstep)",
        (
            "timing: no deadlines in lockstep",
            "task executing, 0 of 4 actions, ",
            "objects 0 of 3 at goal, worst ",
            "motion tracking 0.0",
            " peak; no contact, no limit reached",
            "faults ",
            "cycle ms proc p99 used % missed skipped servo 2.5 ",
            "response command 1282.5 ms (bound 1282.5); status ",
        ),
    ),
    faulty_run: (
        "TIME OVER after 3 s (lockstep)",
        (
            "timing: upper skipped ",
            "faults 1 of 2 acted; 1 detected",
            "restarts upper 1 ",
            "! upper 20 ",
            ": fault 'hang' of upper",
        ),
    ),
    armless_run: (
        "TIME OVER after 0.5 s (lockstep)",
        ("timing: no deadlines in lockstep", "faults ", " level.planner 16 "),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("make", RUNS, ids=lambda make: make.__name__)
def test_the_summary_of_a_run_has_the_verdict_first_and_the_facts_in_order(
    make: Callable[[pytest.TempPathFactory], Path], tmp_path_factory: pytest.TempPathFactory
) -> None:
    headline, parts = RUNS[make]
    folder = make(tmp_path_factory)
    report, text = write_report(folder)
    for width in (40, WIDTH):
        lines = summary(report, width)
        assert flat(lines).startswith(f"{report['rack']}: {headline}")
        for command in ("rack report {} --full", "rack replay {}", "rack analyze {}"):
            assert any(line.endswith(command.format(folder)) for line in lines)
    printed = flat(lines)
    places = [printed.find(part) for part in parts]
    assert -1 not in places, parts[places.index(-1)]
    assert places == sorted(places)
    # A machine that is too busy may delay the clock by so much that it counts as hanging.
    assert ("faults none " in printed) == (not report["faults"] and not report["unexplained"])
    assert not {"Digest", "alpha", "deviation"} & set(printed.split())
    assert report["digest"] in text


def late(**times: Any) -> dict[str, list[Cycle]]:
    """Return traces of a lower level with one cycle that missed its deadline."""
    return {"lower": [*plain_cycles(SETTLED, 50), Cycle(50, flags=MISSED, **times)]}


LONG = (0.0, 0.1, 2.9, 0.1)
CAUSES: dict[str, tuple[dict[str, list[Cycle]], tuple[Stolen, ...], list[Any], str]] = {
    "own execution": (
        late(parts=LONG),
        (),
        [("own execution", 3.1)],
        "cause 1: own execution, up to 3.1 ms lower fits (median 1.2 of 2.5 ms) ",
    ),
    "skipped while it ran": (
        {
            "lower": [
                *late(parts=(0.0, 0.1, 5.0, 0.1))["lower"],
                Cycle(53, PLAIN, flags=skipping(2)),
            ]
        },
        (),
        [("own execution", 5.2)] * 2,
        "cause 3: own execution, up to 5.2 ms lower fits ",
    ),
    "always too long": (
        {"lower": [Cycle(tick, LONG, flags=MISSED) for tick in range(SETTLED, 60, 2)]},
        (),
        [("own execution", 3.1)] * 10,
        "cause 10: own execution, up to 3.1 ms lower is too long (median 3.1 of 2.5 ms) ",
    ),
    "core taken": (
        absence_trace(),
        (),
        [("core taken from the rack", 6.0)],
        "cause 2: core taken from the rack, up to 6 ms lower fits (median 1.2 of 2.5 ms); the"
        " machine was late ",
    ),
    "steal": (
        absence_trace(),
        (Stolen(int(50.2 * 2.5 * MS), int(51 * 2.5 * MS), OTHER, 10),),
        [("hypervisor", None)],
        "cause 2: hypervisor lower fits (median 1.2 of 2.5 ms); the machine was late ",
    ),
    # It used little processor time, and its core stamped another task meanwhile.
    "unknown": (
        late(parts=LONG, processor=0.3),
        (),
        [("not recorded", None)],
        "cause 1: not recorded lower fits (median 1.2 of 2.5 ms) ",
    ),
}


@pytest.mark.parametrize("case", CAUSES)
def test_each_lost_cycle_has_the_cause_that_the_recording_shows(case: str, record: Record) -> None:
    traces, stolen, causes, line = CAUSES[case]
    recording = run_stalled(record, traces)
    recording.cores = CoreRecord(100 * MS, stolen)
    report = build_report(recording) | {"bytes": 0}
    found = [(miss["why"], miss["why_ms"]) for miss in report["misses"]]
    assert found == causes
    assert line in flat(summary(report)) + " "


UNJUDGED = "the system response: there are no bounds yet for a response across racks"
GAP = "5 of 100 rows of lower are missing; ticks 3 to 7; the recorder was killed"
CHANGES: dict[str, tuple[Document, str, str]] = {
    "done": ({"cause": "task done", "reason": "3 parts"}, "DONE in 4 s", "result 3 parts"),
    "failed": (
        {"worked": False, "failures": ["task failed: no way", "level 'x': stuck"]},
        "FAILED after 4 s",
        "because task failed: no way because level 'x': stuck",
    ),
    "stopped": (
        {"worked": False, "cause": "stopped", "failures": ["stopped: SIGINT received"]},
        "STOPPED after 4 s",
        "because SIGINT received",
    ),
    "unjudged": (
        {"cause": "task done", "unjudged": [UNJUDGED]},
        "PARTLY JUDGED, task done, after 4 s",
        f"unjudged {UNJUDGED}",
    ),
    "lost rows": (
        {"cause": "task done", "rows_lost": {"lower": 4}},
        "PARTLY JUDGED, task done, after 4 s",
        "recording 4 rows of lower lost",
    ),
    "incomplete": (
        {
            "worked": False,
            "failures": [f"the recording is incomplete: {GAP}"],
            "recording": GAP,
            "rows_lost": {"lower": 5},
        },
        "FAILED after 4 s",
        f"because the recording is incomplete: {GAP}",
    ),
    "kept": (
        {"cause": "task done", "kept": "kept 1.0 s to 2.0 s; the rest was not kept"},
        "PARTLY JUDGED, task done, after 4 s",
        "recording kept 1.0 s to 2.0 s; the rest was not kept",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", CHANGES)
def test_a_verdict_is_done_only_if_nothing_was_left_out(case: str, small_report: Document) -> None:
    changes, headline, reason = CHANGES[case]
    changes = dict(changes)
    outcome = small_report["outcome"] | {"cause": "time over"}
    outcome |= {key: changes.pop(key) for key in ("cause", "reason") if key in changes}
    lines = summary(small_report | changes | {"outcome": outcome})
    assert flat(lines).startswith(f"{small_report['rack']}: {headline} (lockstep)")
    assert reason in flat(lines)
    assert flat(lines).count("rows of lower") == (case in ("lost rows", "incomplete"))


@pytest.mark.slow
@pytest.mark.parametrize("width", [40, WIDTH])
def test_a_run_with_many_troubles_keeps_to_its_lines(width: int, small_report: Document) -> None:
    lower = small_report["tasks"]["lower"] | {"lateness_ms": {"max": 3.0}}
    tasks = {f"task{k}": lower | {"missed": k * (k > 9), "skipped": 0} for k in range(40)}
    why = "level 'lower': a reason of many words that do not fit into one line of a terminal"
    braking = {"why": "no torque", "since": 3, "lasted_ms": 700.0}
    hold = {"level": "lower", "by": "holding", "why": why, "since_s": 1, "until_s": 2}
    fault = {"kind": "mute", "board": "lower", "struck": 30, "seen": "missed", "is_judged": True}
    miss = {"task": "task9", "tick": 3, "what": "late", "count": 1, "why_ms": 1.0}
    report = small_report | {
        "mode": "realtime",
        "worked": False,
        "failures": [f"{why} {k}" for k in range(20)],
        "tasks": tasks,
        "missed": 735,
        "outcome": small_report["outcome"] | {"brakings": [braking] * 30},
        "holds": [hold | {"lasted_s": 1.0}] * 300,
        "faults": [fault | {"is_within": False, "is_recovered": False}] * 90,
        "unexplained": [{"tick": 1, "text": why}] * 9,
        "misses": [miss | {"why": f"cause {k}"} for k in range(30)],
        "restarts": {f"task{k}": k for k in range(40)},
        "notes": [why] * 30,
    }
    lines = summary(report, width)
    text = flat(lines)
    assert " FAILED after 4 s (real time) timing: task39 missed 39 of " in text
    assert f"because {why} 0 because {why} 1 " in text
    assert "more lines: see --full" in text
    table = [line for line in lines if line.startswith("! task")]
    assert table[0].split()[:2] == ["!", "task39"]
    assert f"{40 - len(table)} more: {30 - len(table)} missed or skipped" in text


@pytest.mark.slow
def test_a_terminal_shows_the_verdict_in_colour_and_a_pipe_the_same_text(
    small_report: Document,
) -> None:
    def shown(report: Document, **terminal: bool) -> str:
        console = Console(file=io.StringIO(), width=100, no_color=False, **terminal)
        show_summary(report, console)
        return str(console.file.getvalue())  # type: ignore[attr-defined]

    assert shown(small_report).splitlines() == summary(small_report)
    assert shown(small_report, force_terminal=True).startswith("\x1b[1;32m")
    failed = small_report | {"worked": False, "failures": ["no"]}
    assert shown(failed, force_terminal=True).startswith("\x1b[1;31m")


@pytest.mark.slow
def test_run_and_report_print_the_summary_and_all_tables_only_with_full(
    small: Path, rack_name: str, tmp_path: Path
) -> None:
    words = ("run", small, "--set", f"name={rack_name}", "--seconds", 0.2)
    ran = rack(*words, "--out", tmp_path / "run")
    assert ran.returncode == 0
    assert ran.stdout == rack("report", tmp_path / "run").stdout
    assert ran.stdout.startswith(f"{rack_name}: TIME OVER after 0.2 s")
    assert f"{rack_name} 0.20 s  tick " in ran.stderr
    full = rack("report", tmp_path / "run", "--full").stdout
    assert json.loads((tmp_path / "run" / "report.json").read_text())["digest"] in flat([full])
    assert {"Cycles, ms", "System response, ms of simulated time: 2"} <= set(full.splitlines())
    wide = [line for line in full.splitlines() if len(line) > 100 and str(tmp_path) not in line]
    assert not wide
    bare = rack(*words, "--no-record").stdout.splitlines()
    assert bare[0].startswith(f"{rack_name}: PARTLY JUDGED, time over, after 0.2 s")
    assert f"unjudged  {UNRECORDED}" in bare
    assert bare[-1] == "files     none, not recorded"
