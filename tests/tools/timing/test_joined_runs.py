"""Responses across three racks in a row, measured from their recordings, and refused recordings."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest

from rack.boards.config.joined import join_racks
from rack.boards.config.toml import to_toml
from rack.tools.recording.checksums import Checksums
from rack.tools.recording.recording import Recording
from rack.tools.timing.joined_runs import format_joined_runs, measure_joined_runs
from tests.processes import RACK
from tests.shared_runs import small_run
from tests.tools.command_line import rack, read_refusal
from tests.warm import run_command

pytestmark = pytest.mark.slow

MOST_S = 200.0
NAME = "test-three"
RACKS = ("top", "middle", "bottom")
IMPORT = {"type": "order_levels:Order", "rate_hz": 50, "max_age_ms": 1000, "delay_ms": 20}
EXPORT = {"order": {"from": "relay.command", "rate_hz": 50}}


def board(slot: int, rate_hz: int, level: str, **keys: object) -> dict[str, object]:
    """Return the table of a board."""
    return {"slot": slot, "rate_hz": rate_hz, "executor": f"order_levels:{level}", **keys}


FROM_LAN = {"reads": {"above": "lan.order"}}
BOARDS = {
    "top": {
        "source": board(2, 25, "Source", below="relay"),
        "relay": board(3, 50, "Relay", above="source"),
    },
    "middle": {"relay": board(2, 50, "Relay", **FROM_LAN)},
    "bottom": {
        "relay": board(2, 100, "Relay", below="sink", **FROM_LAN),
        "sink": board(3, 50, "Sink", above="relay"),
    },
}
Faults = dict[str, list[dict[str, object]]]


DELAY = {"kind": "delay", "board": "relay", "mailbox": "relay.command", "by": 8, "at": 0.5}
MUTE = {"kind": "mute", "board": "lan", "mailbox": "lan.order", "at": 1.5}
FAULTS: Faults = {"middle": [{**DELAY, "for": 0.4}], "bottom": [{**MUTE, "for": 0.2}]}


def write_configs(folder: Path, faults: Faults) -> dict[str, Path]:
    """Write the configs of three racks, the first of which launches the others.

    With faults, the source has another rate, so that orders are not those of a run without faults.
    """
    paths = {}
    for number, rack_ in enumerate(RACKS):
        lan: dict[str, object] = {
            "slot": 6,
            "rate_hz": 100,
            "listen": [f"unix/{NAME}-{rack_}"],
            "connect": [f"unix/{NAME}-{one}" for one in RACKS[:number]],
            # In lockstep, racks that exchange messages wait for each other.
            "peers": [f"{NAME}-{one}" for one in RACKS[number + 1 : number + 2]],
            "launch": [f"{one}.toml" for one in RACKS[1:]] if number == 0 else [],
            "export": EXPORT if number < 2 else {},
        }
        if number > 0:
            source = f"{NAME}-{RACKS[number - 1]}/relay.command"
            lan["import"] = {"order": {"from": source, **IMPORT}}
        head = {"format": 2, "name": f"{NAME}-{rack_}", "python_path": [str(Path(__file__).parent)]}
        tables = {"clock": {"period_ms": 2.5}, "board": BOARDS[rack_], "adapter": {"lan": lan}}
        paths[rack_] = folder / f"{rack_}.toml"
        text = to_toml({**head, **tables, "fault": faults.get(rack_, [])})
        paths[rack_].write_text(text.replace("= 25", "= 50") if faults else text)
    return paths


def run_racks(folder: Path, faults: Faults, seconds: str) -> dict[str, Path]:
    """Run the three racks in lockstep, and return their recordings."""
    configs = write_configs(folder, faults)
    command = [*RACK, "run", configs["top"], "--lockstep", "--seconds", seconds, "--share"]
    done = run_command([*command, "--json", "--out", "top"], MOST_S, cwd=folder, text=True)
    assert done.returncode == 0 or faults, done.stdout + done.stderr
    report = json.loads(done.stdout)
    found = {one["rack"].rpartition("-")[2]: folder / one["folder"] for one in report["others"]}
    return {"top": folder / "top", **found}


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return run_racks(tmp_path_factory.mktemp("plain"), {}, "1.5")


@pytest.fixture(scope="module")
def faulty_runs(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return run_racks(tmp_path_factory.mktemp("faulty"), FAULTS, "2")


def measure(runs: dict[str, Path]) -> dict[str, Any]:
    (found,) = measure_joined_runs([Recording(runs[rack_]) for rack_ in RACKS])
    return found


def test_a_command_is_followed_through_all_racks_to_its_bound(runs: dict[str, Path]) -> None:
    found = measure(runs)
    names = [f"{NAME}-{rack_}" for rack_ in RACKS]
    recordings = {name: Recording(runs[rack_]) for name, rack_ in zip(names, RACKS, strict=True)}
    layouts = {name: recording.layout for name, recording in recordings.items()}
    joined = join_racks([each.rack_config for each in recordings.values()], layouts)
    (chain,) = joined.chains
    assert list(map(str, chain)) == list(found["levels"])
    assert (str(chain[0]), str(chain[-1])) == (f"{names[0]}/source", f"{names[2]}/sink")
    assert found["bound_ms"] == pytest.approx(joined.compute_response_ns(chain) * 1e-6)
    assert (found["holds"], found["beyond"], found["uncertainty_ms"]) == (True, [], 0.0)
    assert found["count"] > 20
    assert found["measured_ms"]["max"] <= found["bound_ms"]
    assert sum(found["parts"].values()) == pytest.approx(found["measured_ms"]["max"])
    links = {f"link to {name}" for name in names[1:]}
    assert {*found["parts"]} == {*names, *links, "waiting for new information"}
    # A cycle of the last relay, the wait for the sink, and its cycle.
    assert found["parts"][names[-1]] <= 10 + 10 + 10 + 20 + 20


@pytest.mark.parametrize(
    ("begin_s", "cause"),
    [
        (0.5, "test-three-middle: fault: delay of relay"),
        (1.5, "fault: mute of lan"),
    ],
)
def test_a_response_beyond_its_bound_names_the_rack_and_the_cause(
    faulty_runs: dict[str, Path], begin_s: float, cause: str
) -> None:
    found = measure(faulty_runs)
    assert found["holds"] is False
    first = begin_s / 2.5e-3
    near = [one for one in found["beyond"] if first - 80 < one["tick"] < first + 200]
    assert near
    assert all(cause in (*one["network"], *one["delayed_by"]) for one in near), near
    unmeasured = {**found, "count": 0, "holds": True}
    lines = [*format_joined_runs([found, unmeasured])]
    held = "across racks: 0 of 2 responses held their bounds"
    assert lines[0] == f"{held}, 1 failed, 1 not measured"
    assert any(line.endswith(cause) for line in lines)
    assert "FAILS: command: at most" in lines[1]


def test_recordings_that_do_not_belong_together_are_refused(
    runs: dict[str, Path],
    faulty_runs: dict[str, Path],
    tmp_path: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    # A copy of a run whose links have no delay budget.
    unbudgeted = Path(shutil.copytree(runs["middle"], tmp_path / "unbudgeted"))
    config = unbudgeted / "config.toml"
    config.write_text(re.sub("(?m)^delay_ms.*\n", "", config.read_text()))
    Checksums(unbudgeted).store("config.toml")
    cases: dict[str, tuple[Sequence[Path], str]] = {
        "another cell": (
            [runs["top"], small_run(tmp_path_factory)],
            "no command passes between 'test-three-top' and the other racks given",
        ),
        "middle missing": (
            [runs["top"], runs["bottom"]],
            "it exchanges messages with test-three-middle",
        ),
        "twice": ([runs["top"], runs["top"]], "give one RUN of each rack; these are of"),
        "another run": (
            [runs["top"], faulty_runs["middle"]],
            "are not of the same run: they have no message of adapter.lan.import.order in common",
        ),
        "no budget": (
            [runs["top"], unbudgeted],
            "rack test-three-middle: adapter.lan.import.order has no delay_ms",
        ),
    }
    for name, (folders, said) in cases.items():
        assert said in read_refusal(rack("analyze", *folders)), name
