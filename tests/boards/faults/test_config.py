"""Faults in a config and in a script: read, appended, given back as text."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from rack.boards.config import FAULTS, list_names, load, load_text, resolve_layout
from rack.boards.errors import ConfigError
from rack.boards.faults.config import FaultConfig
from rack.boards.faults.kind import KINDS

Write = Callable[[str, str], Path]


def test_no_parameter_has_the_name_of_a_common_fault_key() -> None:
    keys = {field.alias or name for name, field in FaultConfig.model_fields.items()}
    assert not [(kind.name, p.name) for kind in KINDS for p in kind.parameters if p.name in keys]


@pytest.mark.parametrize(
    ("text", "seconds"), [("0.5s", 0.5), ("20ms", 0.02), (" 1.5 s ", 1.5), (2, 2.0), (0.25, 0.25)]
)
def test_a_duration_is_a_text_with_its_unit_or_a_number_of_seconds(
    text: object, seconds: float
) -> None:
    fault = FaultConfig.model_validate({"kind": "mute", "board": "wave", "for": text})
    assert fault.lasts == pytest.approx(seconds)


def test_the_faults_of_a_script_come_after_those_of_the_config(small: Path, write: Write) -> None:
    own = 'fault=[{ kind = "hang", board = "upper" }]'
    tables = [f'[[fault]]\nkind = "{kind}"\nboard = "upper"\n' for kind in ("hang", "kill", "mute")]
    path = write("mine.toml", f"{small.read_text()}\n{tables[0]}")
    script = write("script.toml", tables[1] + tables[2])
    assert [fault.kind for fault in load(path, faults=script).fault] == ["hang", "kill", "mute"]
    assert [fault.kind for fault in load(small, [own]).fault] == ["hang"]
    assert load(small, faults=str(script)).fault == load(small, faults=script).fault


@pytest.mark.parametrize("name", list_names(FAULTS))
def test_every_bundled_script_fits_the_nasrem_rack(name: str) -> None:
    config = load("nasrem", ["clock.mode=realtime"], name)
    resolve_layout(config)
    assert config.fault
    assert load_text(config.to_toml_text()) == config


@pytest.mark.parametrize("text", ["[clock]\nspeed = 2\n", "fault = 3\n", 'name = "x"\n'])
def test_a_script_holds_faults_and_nothing_else(small: Path, write: Write, text: str) -> None:
    with pytest.raises(
        ConfigError, match=r"script.toml: \w+: a fault script contains \[\[fault\]\] tables and"
    ):
        load(small, faults=write("script.toml", text))
