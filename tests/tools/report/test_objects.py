"""Objects and their goals: a wrong final position fails the run, and falls are reported."""

from __future__ import annotations

from pathlib import Path

import pytest

from rack.boards.config import load, resolve
from rack.tools.launch.launch import run_rack
from rack.tools.monitor.display import Display
from rack.tools.report.report import write_report
from tests.boards.config.mistakes import find_mistake
from tests.tools.command_line import read_answer

HOME = 'task.action=[{do="home"}]'
GOAL = 'scene.goal=[{object="block1",position=[0.5,0.3,0.475]}]'
BOTH = GOAL.replace("}]", '},{object="block2",position=[0.6,0.3,0.475]}]')
PUSH = 'scene.push=[{body="block1",at=0.3,seconds=0.1,force=[0.0,1.5,0.0]}]'
DROP = """
line((0.0, 0.0, 0.15), body="block1")
line((0.0, 0.0, 0.0), body="block1")
grip()
line((0.0, 0.0, 0.1), body="block1")
release()
stay(0.5)
wait()
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "cause", "fails"),
    [
        ((), "task done", True),
        # A run that ends before its task is not judged.
        (("--seconds", "0.6"), "time over", False),
    ],
    ids=["off", "before"],
)
def test_an_object_off_its_goal_fails_a_task_that_is_done(
    rack_name: str, words: tuple[str, ...], cause: str, fails: bool
) -> None:
    given = [f"--set={setting}" for setting in (f"name={rack_name}", HOME, BOTH, PUSH)]
    options = ("--lockstep", "--no-record", *given, *words)
    report = read_answer("run", "nasrem", *options, status=int(fails))
    end, within = report["objects"]
    assert (end["object"], end["goal"], end["tolerance_mm"]) == ("block1", [0.5, 0.3, 0.475], 10.0)
    assert end["off_mm"] > 20.0
    assert within["object"] == "block2"
    assert within["off_mm"] < 0.1
    assert report["outcome"]["cause"] == cause
    off = f"object 'block1' ended {end['off_mm']:.0f} mm from its goal (tolerance 10 mm)"
    assert report["outcome"]["faults"] == [off] * fails


def test_a_task_of_transfers_states_the_last_place_of_each_object(rack_name: str) -> None:
    moves = [(0.5, 0.1, 0.475), (0.5, 0.2, 0.475)]
    actions = ",".join(f'{{do="transfer",object="block1",to={list(to)}}}' for to in moves)
    other = 'scene.goal=[{object="peg",position=[0.5,-0.3,0.5],tolerance_mm=3.0}]'
    goals = resolve(load("nasrem", [f"name={rack_name}", f"task.action=[{actions}]", other])).goals
    found = {row: (goal.object, goal.position, goal.tolerance_mm) for row, goal in goals.items()}
    assert found == {0: ("block1", moves[-1], 10.0), 2: ("peg", (0.5, -0.3, 0.5), 3.0)}


def test_a_goal_for_an_object_outside_the_scene_is_a_mistake() -> None:
    found = find_mistake("nasrem", GOAL.replace("block1", "block9"))
    why = "no such object; scene.objects: block1"
    assert found.startswith(f'scene.goal[0].object = "block9": {why}')


@pytest.mark.thorough
def test_an_object_released_in_the_air_is_reported_with_its_fall(
    rack_name: str, tmp_path: Path
) -> None:
    (tmp_path / "drop.py").write_text(DROP)
    own = ["host.command.params.script=drop.py", f'python_path=["{tmp_path}"]', GOAL]
    config = load("chimera", [f"name={rack_name}", "clock.mode=lockstep", *own])
    # The object lands at its old place, so only the report shows the fall.
    assert run_rack(config, None, tmp_path / "run", Display()).worked
    report, text = write_report(tmp_path / "run")
    (end,) = report["objects"]
    assert end["off_mm"] < end["tolerance_mm"]
    (drop,) = end["drops"]
    assert drop["mm"] == pytest.approx(100.0, abs=5.0)
    assert f"tick {drop['tick']}, mm {drop['mm']:g}" in text
