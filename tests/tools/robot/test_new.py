"""Tests `rack robot new`: from a model file to an arm that moves, without editing."""

from __future__ import annotations

import os
import pty
import shlex
import sys
import tomllib
from pathlib import Path

import pytest

from rack.boards.config import load
from tests.processes import RACK
from tests.tools.command_line import ROOT, rack, read_answer, read_refusal
from tests.tools.robot.models import LIMIT, joint, link, urdf, written

DESK_ARM = ROOT / "configs" / "examples" / "own-arm" / "desk-arm.xml"
EXAMPLE = DESK_ARM.with_suffix(".toml")
TAIL = "</robot>"
BLOCKS = "a table, two blocks to move"
TURNS = LIMIT.format(low=-1, high=1, effort=9)
LEVER = link("lever", "0.01 0.01 0.01", "0 0 0")
LEVER += joint("aside", "base", "lever", "0 0.2 0", "0 0 1", limit=TURNS)


def follows(leader: str) -> str:
    """Return an arm whose third joint mimics another one."""
    third = '<joint name="j3" type="revolute">'
    return urdf().replace(third, f'{third}<mimic joint="{leader}"/>')


BAD = {
    "no inertia": (urdf().replace('"1.0"', '"0"').replace('"0.01"', '"0"'), "inertia"),
    "two roots": (urdf().replace(TAIL, f'<link name="top"/>{TAIL}'), "roots: base, top"),
    "two links": (urdf().replace(TAIL, f'<link name="l2"/>{TAIL}'), "named twice: link 'l2'"),
    "two joints": (urdf().replace('joint name="j2"', 'joint name="j1"'), "twice: joint 'j1'"),
    "no drives": (urdf(effort=0.0, gripper=False), "no actuator and no effort at j1"),
    "coupled": (follows("j2"), "couples j2, j3, but the joints of an arm are driven independently"),
    "coupled to a held joint": (
        follows("aside").replace(TAIL, LEVER + TAIL),
        "couples j3, aside, but",
    ),
}


@pytest.mark.thorough
@pytest.mark.parametrize("has_jaw", [False, True], ids=["two fingers", "a finger and a jaw"])
def test_a_urdf_transfers_two_blocks_with_nothing_edited(tmp_path: Path, has_jaw: bool) -> None:
    model = written(tmp_path, urdf(jaw=has_jaw), "hand.urdf")
    made = read_answer("robot", "new", model, folder=tmp_path)
    assert made["task"] == BLOCKS, made["notes"]
    words = ("--lockstep", "--out", tmp_path / "run", "--set", "name=hand-of-test")
    report = read_answer("run", "hand", *words, folder=tmp_path)
    assert max(row["off_mm"] for row in report["objects"]) < 5.0


@pytest.mark.slow
def test_values_of_the_urdf_are_used_and_the_others_named_as_guesses(tmp_path: Path) -> None:
    model = written(tmp_path, urdf())
    assert read_answer("robot", "new", model, folder=tmp_path)["task"] == BLOCKS
    text = (tmp_path / "small" / "small.toml").read_text()
    robot = tomllib.loads(text)["robot"]
    assert robot["joints"] == ["j1", "j2", "j3", "j4", "j5", "j6"]
    assert robot["torque"] == [60.0] * 6
    assert robot["velocity"] == [2.0] * 6
    assert robot["gripper"]["open"] == pytest.approx(0.04)
    assert robot["gripper"]["force"] == 30.0
    assert robot["tool_offset"]["quaternion"] in ([1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
    assert set(robot["guessed"]) == {"tool", "acceleration", "jerk", "home"}
    assert "velocity = [2.0, 2.0, 2.0, 2.0, 2.0, 2.0]\n" in text
    assert "\nhome = " in text
    assert "# guessed: free of contact" in text
    refusal = read_refusal(rack("robot", "new", model, folder=tmp_path))
    assert "'small' exists already" in refusal


@pytest.mark.slow
@pytest.mark.parametrize(("text", "why"), BAD.values(), ids=BAD)
def test_a_bad_model_is_refused_in_one_line(tmp_path: Path, text: str, why: str) -> None:
    model = written(tmp_path, text)
    assert why in read_refusal(rack("robot", "new", model, folder=tmp_path))
    assert list(tmp_path.iterdir()) == [model]


@pytest.mark.parametrize(
    ("name", "better"), [("nasrem", "nasrem-arm"), ("A b", "a-b"), ("..", "arm"), ("-x", "x")]
)
def test_a_valid_name_is_proposed(tmp_path: Path, name: str, better: str) -> None:
    words = (DESK_ARM, f"--name={name}", "--out", "new")
    refusal = read_refusal(rack("robot", "new", *words, folder=tmp_path))
    assert refusal.startswith(f"--name = {name}: must be")
    assert refusal.endswith(f"; for example {better}")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "words", "command"),
    [
        ("SixArm.urdf", (), "rack run sixarm"),
        ("6 Ä_.urdf", ("--out", "my arms/new"), "rack run 'my arms/new/6-a.toml'"),
        ("own.urdf", (), "rack run own/own.toml"),
    ],
)
def test_the_command_that_it_prints_finds_the_new_rack(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    model: str,
    words: tuple[str, ...],
    command: str,
) -> None:
    written(tmp_path, urdf(gripper=False), model)
    # By name `rack run` finds this file first.
    written(tmp_path, EXAMPLE.read_text(), "own.toml")
    done = rack("robot", "new", model, *words, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1] == command
    monkeypatch.chdir(tmp_path)
    config = load(shlex.split(command)[2])
    assert config.robot is not None
    assert config.robot.joints == tuple(f"j{k}" for k in range(1, 7))


@pytest.mark.slow
def test_an_arm_without_gripper_tours_and_keeps_the_options(tmp_path: Path) -> None:
    home = "0,-0.6,1.8,0,1.9416,0"
    words = ("--name", "desk", "--home", home, "--gripper", "none")
    done = rack("robot", "new", DESK_ARM, *words, folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "a tour of poses" in done.stdout
    config = load(tmp_path / "desk" / "desk.toml")
    assert config.robot is not None
    assert config.robot.home == (0.0, -0.6, 1.8, 0.0, 1.9416, 0.0)
    assert config.robot.tool == "tip"
    assert config.robot.torque == (40.0, 60.0, 30.0, 10.0, 10.0, 6.0)
    assert "home" not in config.robot.guessed
    assert [action["do"] for action in config.task["action"]] == ["goto"] * 4 + ["home"]


@pytest.mark.slow
def test_the_second_arm_is_fixed_and_free_bodies_are_left_out(tmp_path: Path) -> None:
    text = DESK_ARM.read_text()
    arm = text[text.index('<body name="turret"') : text.index("</worldbody>")]
    second = arm.replace('name="', 'name="second_').replace('pos="0 0 .18"', 'pos="0 1.5 .18"')
    cup = '<body name="cup" pos="1 1 1"><freejoint/><geom size=".02"/></body>'
    both = text.replace("</worldbody>", f"{second}{cup}</worldbody>")
    model = written(tmp_path, both, "both.xml")
    words = ("--tip", "flange", "--name", "one")
    made = read_answer("robot", "new", model, *words, folder=tmp_path)
    assert any("cup" in note for note in made["notes"])
    config = load(tmp_path / "one" / "one.toml")
    assert config.robot is not None
    assert config.robot.joints == ("waist", "shoulder", "elbow", "roll", "pitch", "twist")
    assert "second_waist" not in (tmp_path / "one" / "one.xml").read_text()
    assert 'name="second_turret"' in (tmp_path / "one" / "one.xml").read_text()


@pytest.mark.slow
def test_the_command_asks_on_a_terminal_for_values_that_no_option_gives(tmp_path: Path) -> None:
    arm = written(tmp_path, urdf())
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(tmp_path)
        os.execv(sys.executable, [*RACK, "robot", "new", str(arm), "--home", "0,0.4,1.6,0,0.7,0"])
    os.write(terminal, b"asked\n\nnone\n")
    said = b""
    try:
        while chunk := os.read(terminal, 1 << 16):
            said += chunk
    except OSError:
        pass  # the end of a terminal
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0, said
    assert b"name [small]: " in said
    assert b"tool: a site or body beyond hand, z outward [found]: " in said
    asked = b"gripper: none, or the joint that drives it: left_finger, right_finger [found]: "
    assert asked in said
    robot = tomllib.loads((tmp_path / "asked" / "asked.toml").read_text())["robot"]
    assert "gripper" not in robot
    assert robot["home"] == [0.0, 0.4, 1.6, 0.0, 0.7, 0.0]
