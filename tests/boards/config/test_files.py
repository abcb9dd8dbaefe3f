"""Config files: found, extended, overridden, and given back as text."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from rack.boards.config import CONFIGS, list_names, load, load_text
from rack.boards.config.files import assemble, list_level_classes
from rack.boards.crate.rack import build_preload_request
from rack.boards.errors import ConfigError
from tests.boards.config.mistakes import find_lines, find_mistake

Write = Callable[[str, str], Path]


@pytest.mark.parametrize("name", list_names())
def test_every_bundled_config_survives_as_text(name: str) -> None:
    config = load(name)
    assert load_text(config.to_toml_text()) == config
    assert (
        list_level_classes(assemble(name, (), None).tables) == build_preload_request(config).classes
    )


def test_text_names_a_bundled_model_without_its_folder() -> None:
    config = load("nasrem")
    assert str(CONFIGS) not in config.to_toml_text()
    assert load_text(config.to_toml_text()).robot.model.is_file()


def test_text_of_a_config_with_strings_and_nested_values_loads_again(small: Path) -> None:
    overrides = [
        "board.lower.params = { gains = [1.5, 2e-9], deep = { on = true } }",
        'board.lower.params.note = "two \\"lines\\"\\nand a tab\\t, \\u0001, \\u007f"',
        "board.lower.params.none = []",
        "board.lower.params.most = [inf, -inf]",
        'board.lower.params."odd key.x" = [{ empty = {} }]',
    ]
    config = load(small, overrides)
    assert config.board["lower"].params["deep"] == {"on": True}
    assert load_text(config.to_toml_text()) == config
    config = load(small, [*overrides, "board.lower.params.gain = nan"])
    assert math.isnan(load_text(config.to_toml_text()).board["lower"].params["gain"])


def test_other_racks_in_the_folder_of_a_bundled_one_have_names_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert {"cell", "cell/puma", "cell/k1607"} <= set(list_names())
    assert not {"cell/arm", "brown/kill-each-board", "robots/puma560"} & set(list_names()), (
        "these are no racks"
    )
    assert load("cell/puma").name == "cell-puma"
    (tmp_path / "cell").mkdir()
    (tmp_path / "cell" / "puma").write_text('name = "mine"\nextends = ["cell/puma"]\n')
    monkeypatch.chdir(tmp_path)
    assert load("cell/puma").name == "mine", "a file comes first"


def test_an_unknown_name_gets_the_nearest_known_one() -> None:
    assert find_mistake("nasrm") == "config = \"nasrm\": no such file; did you mean 'nasrem'?"


@pytest.mark.parametrize("given", ["0", "3", "2.0", "'2'", "true"])
def test_no_other_format_is_read(small: Path, given: str) -> None:
    assert find_mistake(small, f"format={given}").startswith("format = ")


def test_bases_are_merged_in_order(small: Path, write: Write) -> None:
    write("first.toml", "seed = 1\n[clock]\nspeed = 3\n")
    write("second.toml", 'seed = 2\n[clock]\nmode = "realtime"\n')
    config = load(write("mine.toml", 'extends = ["small", "first.toml", "second.toml"]\n'))
    assert (config.seed, config.clock.speed, config.clock.mode) == (2, 3.0, "realtime")


def test_an_arm_is_replaced_as_a_whole(write: Write) -> None:
    # An arm without a gripper must not inherit that of the bundled arm.
    model = write("arm.xml", "<mujoco/>")
    arm = f'[robot]\nmodel = "{model.name}"\njoints = ["a"]\ntool = "t"\nhome = [0]\n'
    limits = "velocity = [1]\nacceleration = [1]\njerk = [1]\n"
    config = load(write("mine.toml", f'extends = ["nasrem"]\n{arm}{limits}'))
    assert config.robot.gripper is None
    assert config.robot.model == model.resolve()


def test_a_robot_table_without_a_model_is_merged_like_any_table(write: Write) -> None:
    text = 'extends = ["nasrem"]\n[robot]\nsubsteps = 8\n[scene]\nclearance = 0.03\n'
    config, whole = load(write("mine.toml", text)), load("nasrem")
    assert config.robot == whole.robot.model_copy(update={"substeps": 8})
    assert config.scene == whole.scene.model_copy(update={"clearance": 0.03})


def test_an_incomplete_arm_is_reported_to_inherit_nothing(write: Write) -> None:
    model = write("arm.xml", "<mujoco/>")
    mine = write("mine.toml", f'extends = ["nasrem"]\n[robot]\nmodel = "{model.name}"\n')
    (line,) = [line for line in find_lines(mine) if line.startswith("robot.jerk: missing; ")]
    assert "a [robot] with its own model is a different arm and inherits nothing from" in line


@pytest.mark.parametrize(
    "line",
    [
        "x = " + "[" * 5000 + "]" * 5000,
        ".".join(["a"] * 3000) + " = 1",
        "x = " + "[" * 31 + "]" * 31,
    ],
    ids=["lists", "dotted keys", "just too deep"],
)
def test_endless_nesting_is_refused_in_one_line(write: Write, line: str) -> None:
    found = find_mistake(write("deep.toml", f'extends = ["fig2"]\n[task]\n{line}\n'))
    assert re.fullmatch(r"deep\.toml.*: nested too deeply: the limit is 32 levels", found)
    assert len(found) < 200


VALUES = {
    "6000 digits": ("9" * 6000, "integer too long: the limit is 64 bits"),
    "date": ("1990-03-01", 'task.x = "1990-03-01": dates and times are not permitted'),
    "NUL": ('"a\\u0000b"', r'task.x = "a\?b": text must not contain NUL'),
}


@pytest.mark.parametrize(("value", "expected"), VALUES.values(), ids=VALUES)
def test_values_that_no_config_may_have_are_refused_in_files_and_settings(
    write: Write, small: Path, value: str, expected: str
) -> None:
    with pytest.raises(ConfigError, match=f"^odd.toml: {expected}"):
        load(write("odd.toml", f"[task]\nx = {value}\n"))
    with pytest.raises(ConfigError, match=r"^--set = .*: (integer|dates|text) "):
        load(small, [f"task.x={value}"])


def test_an_endless_chain_of_files_is_refused(write: Write) -> None:
    for at in range(40):
        write(f"chain{at}.toml", f'extends = ["chain{at + 1}.toml"]\n')
    found = find_mistake(write("chain40.toml", "").with_name("chain0.toml"))
    assert found.endswith(
        "chain32.toml: extends: the chain of extended files is longer than 32 files"
    )


def test_a_file_that_many_extend_is_read_once(small: Path, write: Write) -> None:
    # Every file has two bases, which have the same two: 2^24 ways from the first to the last.
    for at in range(24):
        for twin in "ab":
            write(f"{twin}{at}.toml", f'extends = ["a{at + 1}.toml", "b{at + 1}.toml"]\n')
    for twin in "ab":
        write(f"{twin}24.toml", 'extends = ["small.toml"]\n')
    assert load(small.with_name("a0.toml")).name == "small"


def test_a_fifo_or_a_device_in_place_of_a_file_is_refused_at_once(
    small: Path, write: Write, tmp_path: Path
) -> None:
    os.mkfifo(fifo := tmp_path / "fifo.toml")
    (device := tmp_path / "device.toml").symlink_to("/dev/zero")
    for path, kind in ((fifo, "FIFO"), (device.resolve(), "character device")):
        why = f"{path}: cannot be read: not a regular file, but a {kind}"
        extending = write("mine.toml", f'extends = ["{path}"]\n')
        for config, faults in ((path, None), (small, path), (extending, None)):
            assert find_lines(config, faults=faults) == [why]


@pytest.mark.parametrize("name", ["~nosuchuser/x.toml", "a/" * 3000, "a\0b.toml"])
def test_an_impossible_file_name_is_reported_as_missing(
    small: Path, write: Write, name: str
) -> None:
    found = find_mistake(name)
    assert re.match(r"config = .*: no such file; valid are a path or one of the names ", found)
    assert len(found) - len(", ".join(list_names())) < 160, "it is cut, apart from names of racks"
    (found,) = find_lines(small, faults=name)
    assert re.match(r"--faults = .*: no such file", found)
    if "\0" not in name:
        found = find_mistake(write("mine.toml", f'extends = ["{name}"]\n'))
        assert re.search(r"extends = .*: no such file", found)


def test_a_config_that_extends_itself_is_refused(write: Write) -> None:
    write("a.toml", 'extends = ["b.toml"]')
    found = find_lines(write("b.toml", 'extends = ["a.toml"]'))
    assert "extends itself: b.toml -> a.toml -> b.toml" in found[0]


@pytest.mark.parametrize(
    ("setting", "found"),
    [
        ("clock.mode=realtime", lambda c: c.clock.mode == "realtime"),
        (
            " protocol . mailbox . 'lower.status' = lock",
            lambda c: c.protocol.mailbox == {"lower.status": "lock"},
        ),
        ('task."a = b"=1', lambda c: c.task == {"a = b": 1}),
        ("board.lower.params.gains=[1, 2]", lambda c: c.board["lower"].params == {"gains": [1, 2]}),
    ],
)
def test_overrides_set_single_values(small: Path, setting: str, found: Callable[..., bool]) -> None:
    assert found(load(small, [setting]))


def test_an_override_reaches_into_a_list(small: Path) -> None:
    settings = ['task.action=[{ do = "home" }, { do = "home" }]', "task.action.1.by=30"]
    assert load(small, settings).task["action"] == [{"do": "home"}, {"do": "home", "by": 30}]


def test_every_impossible_override_is_reported(small: Path) -> None:
    assert find_lines(small, "clock", "name.low=1", ".=2") == [
        '--set = "clock": must be key=value, as in clock.speed=2',
        '--set = "name.low=1": "low" cannot be set in "small", which is not a table',
        '--set = ".=2": must be key=value, as in clock.speed=2',
    ]


def test_a_fault_script_of_the_rack_precedes_a_bundled_one_of_the_same_name(write: Write) -> None:
    rack = write("mine.toml", 'name = "mine"')
    bundled = assemble(rack, (), "overload").tables["fault"]
    write("overload.toml", "[[fault]]\nkind = 'kill'\nboard = 'lower'\ntick = 5")
    own = assemble(rack, (), "overload").tables["fault"]
    assert (len(own), own[0]["board"]) == (1, "lower")
    assert bundled != own


def test_classes_are_found_in_tables_that_have_not_been_checked() -> None:
    named = {"executor": "mine:Arm", "planner": "mine:Planner"}
    boards = {"one": named, "two": {"executor": "mine:Arm"}, "odd": 3, "wrong": {"executor": 7}}
    assert list_level_classes({"board": boards}) == ("mine:Arm", "mine:Planner")
    assert list_level_classes({"board": [1]}) == list_level_classes({}) == ()


def test_a_config_in_the_current_folder_is_found_by_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "mine.toml").write_text('format = 2\nname = "mine"\nextends = ["fig2"]\n')
    (tmp_path / "fig2.toml").write_text('format = 2\nname = "other"\n')
    monkeypatch.chdir(tmp_path)
    assert assemble("mine", (), None).tables["name"] == "mine"
    assert assemble("fig2", (), None).tables["name"] == "fig2"
