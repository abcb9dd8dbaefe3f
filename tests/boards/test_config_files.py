"""Config files: found, extended, overridden, and given back as text."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from boards.config import CONFIGS, load, loads, names
from boards.errors import ConfigError

Write = Callable[[str, str], Path]


def lines(error: pytest.ExceptionInfo[ConfigError]) -> list[str]:
    return str(error.value).splitlines()


@pytest.mark.parametrize("name", names())
def test_every_bundled_config_survives_as_text(name: str) -> None:
    config = load(name)
    assert loads(config.text()) == config


def test_text_names_a_bundled_model_without_its_folder() -> None:
    config = load("nasrem")
    assert str(CONFIGS) not in config.text()
    assert loads(config.text()).robot.model.is_file()


def test_text_of_a_config_with_strings_and_nested_values_loads_again(small: Path) -> None:
    overrides = [
        'board.lower.params = { note = "two \\"lines\\"\\nand a tab\\t", gains = [1.5, 2e-9], deep = { on = true } }'
    ]
    config = load(small, overrides)
    assert config.board["lower"].params["deep"] == {"on": True}
    assert loads(config.text()) == config


def test_an_unknown_name_lists_the_names_there_are() -> None:
    with pytest.raises(ConfigError) as error:
        load("nasrm")
    assert lines(error) == [f'config = "nasrm": no such file; by name: {", ".join(names())}; or a path']


def test_what_is_not_toml_is_told_with_its_line(write: Write) -> None:
    with pytest.raises(ConfigError, match=r"broken.toml: not TOML: .*line 2"):
        load(write("broken.toml", 'name = "x"\nclock = = 3\n'))


def test_a_file_overrides_what_it_extends_key_by_key(small: Path, write: Write) -> None:
    path = write("mine.toml", 'name = "mine"\nextends = ["small.toml"]\n[board.upper]\nrate_hz = 100\n')
    config = load(path)
    assert (config.name, config.board["upper"].rate_hz, config.board["upper"].slot) == ("mine", 100, 2)


def test_bases_are_merged_in_order(small: Path, write: Write) -> None:
    write("first.toml", "seed = 1\n[clock]\nspeed = 3\n")
    write("second.toml", 'seed = 2\n[clock]\nmode = "realtime"\n')
    config = load(write("mine.toml", 'extends = ["small", "first.toml", "second.toml"]\n'))
    assert (config.seed, config.clock.speed, config.clock.mode) == (2, 3.0, "realtime")


def test_an_arm_is_replaced_as_a_whole(write: Write) -> None:
    # The gripper of the bundled arm must not stay behind on one that has none.
    model = write("arm.xml", "<mujoco/>")
    arm = f'[robot]\nmodel = "{model.name}"\njoints = ["a"]\ntool = "t"\nhome = [0]\n'
    limits = "velocity = [1]\nacceleration = [1]\njerk = [1]\n"
    config = load(write("mine.toml", f'extends = ["nasrem"]\n{arm}{limits}'))
    assert config.robot.gripper is None
    assert config.robot.model == model.resolve()


def test_a_config_that_extends_itself_is_refused(write: Write) -> None:
    write("a.toml", 'extends = ["b.toml"]')
    with pytest.raises(ConfigError, match=r"extends itself: b.toml -> a.toml -> b.toml"):
        load(write("b.toml", 'extends = ["a.toml"]'))


def test_every_missing_base_is_told(write: Write) -> None:
    with pytest.raises(ConfigError) as error:
        load(write("mine.toml", 'extends = ["no.toml", "nor.toml"]'))
    assert [mistake.value for mistake in error.value.mistakes] == ["no.toml", "nor.toml"]


@pytest.mark.parametrize(
    ("setting", "found"),
    [
        ("clock.mode=realtime", lambda c: c.clock.mode == "realtime"),
        ("board.upper.every = 4", None),
        ("seed=7", lambda c: c.seed == 7),
        ('protocol.mailbox={"lower.status" = "lock"}', lambda c: c.protocol.mailbox == {"lower.status": "lock"}),
        ("board.lower.params.gains=[1, 2]", lambda c: c.board["lower"].params == {"gains": [1, 2]}),
    ],
)
def test_overrides_set_single_values(small: Path, setting: str, found: Callable[..., bool] | None) -> None:
    if found is not None:
        assert found(load(small, [setting]))
        return
    with pytest.raises(ConfigError, match="every is given as well"):
        load(small, [setting])


def test_an_override_reaches_into_a_list(small: Path) -> None:
    settings = ['task.action=[{ do = "home" }, { do = "home" }]', "task.action.1.by=30"]
    assert load(small, settings).task["action"] == [{"do": "home"}, {"do": "home", "by": 30}]


def test_every_override_that_cannot_be_is_told(small: Path) -> None:
    with pytest.raises(ConfigError) as error:
        load(small, ["clock", "name.low=1", ".=2"])
    assert lines(error) == [
        '--set = "clock": must be key=value, as in clock.speed=2',
        '--set = "name.low=1": "low" would stand in "small", which is no table',
        '--set = ".=2": must be key=value, as in clock.speed=2',
    ]
