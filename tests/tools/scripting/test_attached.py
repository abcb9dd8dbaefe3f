"""Tests reading and commanding a rack that runs in the background of a program."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import rack
from rack.backplane.segment import list_racks
from rack.backplane.words import Demand, System
from rack.boards import Rack
from rack.boards.events import Event
from rack.tools.scripting.attached import AttachedRack
from tests.boards.commanded_racks import COMMANDED
from tests.processes import BOUND_S, named, wait_until

SCRIPT = """
import sys
from rack import Rack, attach

with Rack.from_file({path!r}, ["name={name}"]) as own, attach({name!r}) as live:
    own.run_in_background()
    live.wait_until("lower.status.count > 100", timeout_s=50)
    print("runs", flush=True)
    {then}
"""


@pytest.fixture(scope="module", params=["lockstep", "realtime"])
def own(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rack]:
    """A rack that runs in the background, until the last of its tests stops it."""
    path = tmp_path_factory.mktemp("own") / "commanded.toml"
    path.write_text(COMMANDED)
    name = f"{os.getpid()}-{request.param}"
    with Rack.from_file(path, [f"name={name}", f"clock.mode={request.param}"]) as own:
        own.run_in_background()
        yield own
    assert name not in list_racks()
    wait_until(lambda: not named(f"{name}:"))


@pytest.fixture
def live(own: Rack) -> Iterator[AttachedRack]:
    with rack.attach(own.config.name) as live:
        yield live


@pytest.mark.slow
def test_a_rack_runs_while_its_program_reads_and_commands(own: Rack, live: AttachedRack) -> None:
    assert live.status().rack == own.config.name
    assert live.wait_until("lower.status.count > 20", BOUND_S) >= 20
    reading = live.read("lower.status")
    assert live["lower.status.count"] >= reading.message.count > 20
    assert live["lower.status.state"] == "executing"
    assert live["lower.status.reason"] == ""
    reply = live.command("upper", "hold", wait_s=BOUND_S)
    assert (reply.fate, reply.done >= reply.taken_up) == ("done", True)
    assert live.wait_for("command", BOUND_S).subject == "upper"
    held = live["lower.status.count"]
    assert live.command("upper", "resume").worked
    live.wait_until(f"lower.status.count > {held}", BOUND_S)
    assert own.wait(0.0) is None


@pytest.mark.slow
def test_errors_have_the_text_of_the_command(own: Rack, live: AttachedRack) -> None:
    with pytest.raises(rack.Failure, match=r"refused at tick .*: the way home is closed$"):
        live.command("upper", "goto", home=True)
    cases: dict[str, Callable[[], object]] = {
        "lower.statsu.count: no such signal; nearest: lower": lambda: live["lower.statsu.count"],
        "lower.statsu: no such mailbox; nearest: lower": lambda: live.read("lower.statsu"),
        "detection: not within 0 s$": lambda: live.wait_for("detection", 0.0),
        "< 0: not within 0 s$": lambda: live.wait_until("lower.status.count < 0", 0.0),
        "by=2: not a live parameter": lambda: live.set("board.upper.params.by", 2),
        '^kind = "kil"': lambda: live.inject("lower", "kil"),
        "^rack 'no-such-rack' does not exist": lambda: rack.attach("no-such-rack"),
    }
    for why, do in cases.items():
        with pytest.raises(rack.Failure, match=why):
            do()


@pytest.mark.slow
def test_a_parameter_is_set_and_a_pause_holds_the_rack(own: Rack, live: AttachedRack) -> None:
    assert live.set("board.lower.params.by", 3).fate in ("taken", "done")
    pause = live.pause()
    lockstep = own.config.clock.mode == "lockstep"
    assert pause.levels == ([] if lockstep else ["upper"])
    count = live["lower.status.count"]
    live.resume()
    live.wait_until(f"lower.status.count > {count}", BOUND_S)
    live.estop()
    words = own.segment.words
    wait_until(lambda: words[System.DEMAND] == Demand.BRAKE)
    live.estop(reset=True)
    wait_until(lambda: words[System.DEMAND] != Demand.BRAKE)


@pytest.mark.slow
def test_a_rack_is_stopped(own: Rack) -> None:
    own.stop()
    outcome = own.wait(BOUND_S)
    assert outcome is not None
    assert outcome.cause == "stopped"


@pytest.mark.slow
def test_an_error_of_its_supervision_ends_a_rack_and_is_shown(
    commanded: Path, rack_name: str
) -> None:
    def fail(event: Event) -> None:
        if event.kind == "command":
            raise RuntimeError("no more")

    config = Rack.from_file(commanded, [f"name={rack_name}", "clock.mode=lockstep"]).config
    with pytest.raises(RuntimeError, match="no more"), Rack(config, fail) as own:  # noqa: PT012
        own.run_in_background()
        own.command("upper", "hold")
        wait_until(lambda: own.segment.run_is_over)
    assert rack_name not in list_racks()


@pytest.mark.slow
@pytest.mark.parametrize(("then", "status"), [("sys.stdin.read()", 130), ("own.close = None", 0)])
def test_a_program_that_is_interrupted_or_ends_leaves_nothing(
    commanded: Path, rack_name: str, then: str, status: int
) -> None:
    script = SCRIPT.format(path=str(commanded), name=rack_name, then=then)
    if status == 0:
        # As in a notebook: nobody closes it.
        script = script.replace(
            f'with Rack.from_file({str(commanded)!r}, ["name={rack_name}"]) as own,',
            f'own = Rack.from_file({str(commanded)!r}, ["name={rack_name}"])\nown.launch()\nwith',
        ).replace("own.close = None", "pass")
    process = subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "runs\n"
    if status:
        os.kill(process.pid, signal.SIGINT)
    process.communicate(timeout=BOUND_S)
    assert process.returncode == (-signal.SIGINT if status else 0)
    assert rack_name not in list_racks()
    wait_until(lambda: not named(f"{rack_name}:"))


def test_waiting_for_a_clock_that_was_not_started_fails(commanded: Path, rack_name: str) -> None:
    with (
        Rack.from_file(commanded, [f"name={rack_name}", "clock.mode=lockstep"]),
        rack.attach(rack_name) as live,
        pytest.raises(rack.Failure, match=r"^mailbox 'lower\.status' has no message yet$"),
    ):
        live["lower.status.count"]


def test_to_import_rack_imports_no_library() -> None:
    heavy = "{'numpy', 'pandas', 'pyarrow', 'pydantic', 'mujoco', 'typer'}"
    code = f"import sys, rack; assert not {heavy} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=BOUND_S)
