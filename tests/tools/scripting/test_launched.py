"""Tests a rack that a program launches: its settings, and its recording, equal to `rack run`'s."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Mapping
from contextlib import closing
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rack
from rack.backplane.segment import Segment
from rack.boards.config import load
from rack.boards.config.toml import apply_settings
from rack.boards.events import Event
from rack.tools.recording.recorder import process as recorder_process
from rack.tools.recording.recorder.process import RecorderProcess
from rack.tools.recording.recording import Recording
from rack.tools.scripting.launched import list_settings
from tests.boards.commanded_racks import COMMANDED
from tests.processes import BOUND_S, run_to_end

LOCKSTEP = {"clock.mode": "lockstep"}


@pytest.mark.parametrize(
    "settings",
    [
        {"clock": {"period_ms": 5, "mode": "lockstep"}, "board": {"lower.params.by": 3}},
        {"clock.period_ms": np.float64(5.0), "clock.mode": "lockstep", "board.lower.params.by": 3},
        {"clock": {"period_ms": 5}, "board": {"lower": {"params": {"by": np.int64(3)}}}},
    ],
    ids=["nested", "dotted", "numpy"],
)
def test_settings_are_those_of_the_command(commanded: Path, settings: Mapping[str, Any]) -> None:
    overrides = ["clock.period_ms=5", "clock.mode=lockstep", "board.lower.params.by=3"]
    assert rack.Rack(commanded, lockstep=True, settings=settings).config == load(
        commanded, overrides
    )


def test_values_of_python_become_those_of_a_config(commanded: Path) -> None:
    fault = {"kind": "kill", "board": "lower", "at": np.float64(0.5)}
    settings = {"fault": (fault,), "python_path": [commanded.parent], 'board."lower".restarts': 2}
    config = rack.Rack(commanded, settings=settings).config
    assert [(one.kind, one.board, one.at) for one in config.fault] == [("kill", "lower", 0.5)]
    assert config.python_path == (commanded.parent,)
    assert config.board["lower"].restarts == 2


VALUES = [
    True,
    3,
    -0.25,
    math.inf,
    "a = 'b'\n\"c\" \N{SNOWMAN}",
    [1, [2.5, "x"]],
    [],
    [{"k.l": [{}]}],
]


@pytest.mark.parametrize("value", VALUES, ids=repr)
def test_a_value_of_python_is_read_as_it_is(value: object) -> None:
    assert apply_settings({}, [*list_settings({"table": {"key": value}})], []) == {
        "table": {"key": value}
    }


def test_arrays_are_lists() -> None:
    (setting,) = list_settings({"key": np.arange(4.0).reshape(2, 2)})
    assert setting == "key=[[0.0, 1.0], [2.0, 3.0]]"


MISTAKES: dict[str, Any] = {
    "clock.sped = 2: unknown key; did you mean 'speed'?": {"clock": {"sped": 2}},
    'clock.period_ms = "x": ': {"clock.period_ms": "x"},
    '--set = "clock..x=2": must be key=value, as in clock.speed=2': {"clock": {".x": 2}},
    """settings = "clock.speed": Object of type 'NoneType' is not TOML serializable""": {
        "clock": {"speed": None}
    },
    '--set = "fault.0.at=1": "0" is not an index of a list of 0': {"fault.0.at": 1},
    '--set = "name=1979-05-27": dates and times are not permitted': {"name": date(1979, 5, 27)},
}


@pytest.mark.parametrize(("why", "settings"), MISTAKES.items(), ids=MISTAKES)
def test_mistakes_of_settings_have_the_sentences_of_the_command(
    commanded: Path, why: str, settings: Any
) -> None:
    if "list of 0" in why:
        commanded.write_text(f"fault = []\n{COMMANDED}")
    with pytest.raises(rack.ConfigError) as found:
        rack.Rack(commanded, settings=settings)
    assert str(found.value).startswith(why)
    assert isinstance(found.value, rack.Failure)
    assert (found.value.status, len(found.value.mistakes)) == (2, 1)


def test_a_loaded_config_takes_no_settings(commanded: Path) -> None:
    with pytest.raises(TypeError, match="takes no settings"):
        rack.Rack(load(commanded), settings=LOCKSTEP)


@pytest.mark.slow
def test_a_recorded_rack_leaves_the_run_of_the_command(
    commanded: Path, tmp_path: Path, rack_name: str
) -> None:
    heard: list[Event] = []
    out = tmp_path / "run"
    settings = {**LOCKSTEP, "name": rack_name}
    with rack.Rack(commanded, settings=settings, out=out, on_event=heard.append) as own:
        assert repr(own) == f"<rack '{rack_name}': not over, recorded into {out}>"
        outcome = own.run(1.0)
    assert repr(own) == f"<rack '{rack_name}': time over, recorded into {out}>"
    recording = Recording(out)
    assert recording.end_counts["outcome"]["digest"] == outcome.digest
    assert recording.end_counts["recording"] == "complete"
    assert recording.end_counts["tasks"]["lower"]["cycles"] == 400
    run = rack.open_run(out)
    assert run.signals["lower.status.count"].ticks.tolist() == list(range(400))
    assert [event.kind for event in run.events] == [event.kind for event in heard]
    assert run.report["worked"]
    # By its code it can be repeated.
    with run.at(0.5).resume(seconds=1.0) as again:
        assert again.wait(BOUND_S) == outcome
    with pytest.raises(rack.Failure, match="exists already and is not an empty folder"):
        rack.Rack(commanded, settings=settings, out=out)


@pytest.mark.slow
def test_a_rack_stays_until_its_recorder_has_begun(
    commanded: Path, tmp_path: Path, rack_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits: list[float] = []
    wait: Callable[[RecorderProcess, float], bool] = RecorderProcess.wait_until_attached

    def note(recorder: RecorderProcess, bound_s: float = math.inf) -> bool:
        # Raises when the rack is gone.
        with closing(Segment.attach(rack_name)):
            waits.append(bound_s)
            return wait(recorder, bound_s)

    monkeypatch.setattr(RecorderProcess, "wait_until_attached", note)
    settings = {**LOCKSTEP, "name": rack_name}
    with rack.Rack(commanded, settings=settings, out=tmp_path / "run") as own:
        own.run(0.1)
    assert waits == [recorder_process.ATTACH_S, math.inf]
    assert Recording(tmp_path / "run").end_counts["recording"] == "complete"


@pytest.mark.slow
def test_a_rack_that_is_not_launched_leaves_no_folder(
    commanded: Path, tmp_path: Path, rack_name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[RecorderProcess] = []
    start: Callable[[RecorderProcess], None] = RecorderProcess._start

    def note(recorder: RecorderProcess) -> None:
        started.append(recorder)
        start(recorder)

    monkeypatch.setattr(RecorderProcess, "_start", note)
    settings = {**LOCKSTEP, "name": rack_name, "board.lower.executor": "rack.levels.none:None"}
    own = rack.Rack(commanded, settings=settings, out=tmp_path / "run")
    with pytest.raises(rack.ConfigError), own:
        pass
    assert not (tmp_path / "run").exists()
    (recorder,) = started
    assert recorder._process.poll() is not None


@pytest.mark.slow
def test_a_recording_that_cannot_be_written_is_a_failure(
    commanded: Path, tmp_path: Path, rack_name: str
) -> None:
    (tmp_path / "file").write_text("")
    settings, out = {**LOCKSTEP, "name": rack_name}, tmp_path / "file" / "run"
    own = rack.Rack(commanded, settings=settings, out=out)
    with pytest.raises(rack.Failure, match=r"run: Not a directory$"), own:
        pass


def test_a_prompt_completes_the_public_names_alone() -> None:
    names = ["ConfigError", "Failure", "Rack", "attach", "open_run"]
    assert dir(rack) == names
    code = "import json, rack; rack.Rack; print(json.dumps(dir(rack)))"
    command = [sys.executable, "-c", code]
    assert json.loads(run_to_end(command, BOUND_S, check=True).stdout) == names
