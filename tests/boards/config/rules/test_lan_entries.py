"""Mistakes in `[adapter.lan]`: each one line, under the place that its user has written."""

from __future__ import annotations

import importlib.util
from importlib.machinery import ModuleSpec
from pathlib import Path

import pytest

from rack.boards.config import load, resolve
from rack.boards.config.loader import load_text
from rack.boards.config.toml import parse_tables, to_toml
from rack.boards.errors import ConfigError
from tests.boards.config.mistakes import find_mistake, list_mistakes, read_config
from tests.boards.lan.racks import rack_text

TEXT = rack_text("one", "tcp/127.0.0.1:7447", [], "two", peers=["three"])
TESTS = Path(__file__).parents[3]
IMPORT = "type = 'lan_levels:PulseStatus', max_age_ms = 500"
MISTAKES = [
    (
        "adapter.lan.import.other.rate_hz=15",
        "adapter.lan.import.other.rate_hz = 15.0: exchange: 15 Hz does not divide the 50 Hz of the"
        " adapter; nearest: 12.5 Hz (every 4 cycles), 16.67 Hz (every 3 cycles)",
    ),
    (
        "adapter.lan.rate_hz=33",
        "adapter.lan.import.other.rate_hz=33",
        "adapter.lan.export.pulse.rate_hz=33",
        "adapter.lan.rate_hz: level 'lan': 33 Hz does not divide the 400 Hz clock",
    ),
    # A servo loop.
    (
        "board.pulse.rate_hz=400",
        'export.pulse.from = "pulse.status": written at 400 Hz, too fast for a loop over a network,'
        " which can run at up to 50 Hz",
    ),
    (
        "adapter.lan.export.pulse.from=pulse.pulse",
        'export.pulse.from = "pulse.pulse": no such mailbox; mailboxes: pulse.status, echo.status',
    ),
    (
        "adapter.lan.export.again={ from = 'lan.other' }",
        'adapter.lan.export.again.from = "lan.other": the adapter itself writes it',
    ),
    (
        f"python_path=['{TESTS / 'boards'}', '{TESTS / 'boards/lan'}']",
        "board.sender={ slot = 9, every = 8, executor = 'queue_levels:Asking', params.burst = 1 }",
        "adapter.lan.export.again={ from = 'sender.requests' }",
        'adapter.lan.export.again.from = "sender.requests": a queue gives each message once',
    ),
    (
        f"adapter.lan.import.own={{ from = 'one/pulse.status', {IMPORT} }}",
        'adapter.lan.import.own.from = "one/pulse.status": this mailbox belongs to this rack',
    ),
    ("adapter.lan.peers=['one']", 'lan.peers = "one": this is the name of this rack itself'),
    (
        "adapter.lan.peers=['a-b', 'a_b']",
        "adapter.lan.peers = ['a-b', 'a_b']: these names differ only in '-' and '_', so they would"
        " share mailbox lan.peer_a_b",
    ),
    (
        "adapter.lan.import.other.type=lan_levels:Plus",
        "import.other.type = \"lan_levels:Plus\": module 'lan_levels' has no message class 'Plus'",
    ),
    # A type with sizes of an arm.
    (
        "adapter.lan.import.more={ from = 'two/servo.command', type ="
        " 'rack.levels.messages:JointCommand', max_age_ms = 500 }",
        'adapter.lan.import.more.type = "rack.levels.messages:JointCommand": ',
    ),
    (
        "adapter.lan.import.other.type=lan_levels:Heard",
        'board.echo.reads.other = "lan.other": carries heard 1; the port needs pulse 1',
    ),
    (
        "adapter.lan.import.other.rate_hz=10",
        "adapter.lan.import.other.max_age_ms = 100.0: between two exchanges a message gets as old"
        " as their interval and one cycle of the adapter; must be at least 120 ms",
    ),
    (
        f"adapter.lan.import.again={{ from = 'two/pulse.status', rate_hz = 50, {IMPORT} }}",
        'adapter.lan.import = "two/pulse.status": listed 2 times: other, again',
    ),
    (
        f"adapter.lan.import.status={{ from = 'two/a.b', {IMPORT} }}",
        "adapter.lan.import.status: the adapter writes its status under this name",
    ),
    (
        "board.lan={ slot = 9, rate_hz = 50, executor = 'lan_levels:Pulse' }",
        "board.lan: [adapter.lan] adds a board of this name",
    ),
    (
        "board.net={ slot = 9, rate_hz = 50, executor = 'rack.boards.lan.adapter:LanAdapter' }",
        'board.net.executor = "rack.boards.lan.adapter:LanAdapter": this class needs the table',
    ),
    (
        "clock.mode=realtime",
        "adapter.lan.priority=40",
        "board.pulse.priority=40",
        "adapter.lan.priority = 40: must be above the other boards on core 0, pulse 40",
    ),
    (
        "clock.mode=realtime",
        "protocol.strict=true",
        "adapter.lan: messages of other racks make a run depend on timing",
    ),
]
"""Settings, and what the mistake says."""


def resolved(*settings: str) -> None:
    """Check the config with these settings, in lockstep if they do not say otherwise."""
    resolve(read_config(TEXT, ["clock.mode=lockstep", *settings]))


@pytest.mark.parametrize("case", MISTAKES, ids=lambda case: case[-1])
def test_a_mistake_is_one_line(case: tuple[str, ...]) -> None:
    *settings, line = case
    found = find_mistake(TEXT, "clock.mode=lockstep", *settings)
    assert line in found
    assert "board.lan." not in found


def test_valid_tables_have_no_mistakes() -> None:
    resolved()
    resolved("protocol.strict=true")
    resolved("clock.mode=realtime", "adapter.lan.priority=41", "board.pulse.priority=40")
    resolved("clock.mode=realtime", "adapter.lan.core=1", "board.pulse.priority=40")
    resolved("adapter.lan.import.other.rate_hz=10", "adapter.lan.import.other.max_age_ms=120")


def test_the_loss_of_the_adapter_has_the_same_reaction_as_the_loss_of_a_peer() -> None:
    for rule, on_loss in (("hold", "hold"), ("stop", "stop"), ("go on", "hold")):
        text = rack_text("one", "", [], "two", lan=f'on_peer_loss = "{rule}"')
        assert load_text(text).board["lan"].on_loss == on_loss


def test_endpoints_can_be_set_for_a_run(tmp_path: Path) -> None:
    path = tmp_path / "rack.toml"
    path.write_text(TEXT)
    config = load(path, ['adapter.lan.listen=["tcp/127.0.0.1:7555"]', "adapter.lan.lease_ms=100"])
    assert config.adapter.lan is not None
    assert config.board["lan"].params["listen"] == ("tcp/127.0.0.1:7555",)
    # What a segment carries loads to the same config.
    assert load_text(config.to_toml_text()) == config


def test_a_rack_without_zenoh_gets_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    found = importlib.util.find_spec

    def no_zenoh(name: str, package: str | None = None) -> ModuleSpec | None:
        return None if name == "zenoh" else found(name, package)

    monkeypatch.setattr("rack.boards.config.rules.lan.find_spec", no_zenoh)
    monkeypatch.setitem(__import__("sys").modules, "zenoh", None)
    for module in ("link", "entries", "adapter"):
        monkeypatch.delitem(__import__("sys").modules, f"rack.boards.lan.{module}", raising=False)
    why = "an exchange with other racks needs eclipse-zenoh: pip install 'nasrem-rack[lan]'"
    assert find_mistake(TEXT) == f"adapter.lan: {why}"


def test_an_adapter_in_a_rack_without_boards_hides_no_mistake() -> None:
    tables = parse_tables(TEXT)
    del tables["board"]
    with pytest.raises(ConfigError, match=r"^board: missing; boards by name"):
        load_text(to_toml(tables))


@pytest.mark.slow
def test_operator_commands_cannot_be_exported(tmp_path: Path) -> None:
    path = tmp_path / "arm.toml"
    table = '[adapter.lan]\nslot = 12\nlisten = ["tcp/127.0.0.1:7447"]\npeers = ["b"]\n'
    entry = '[adapter.lan.export.out]\nrate_hz = 10\nfrom = "{}"\n'
    for source, expected in (("servo.operator", True), ("elemental_move.status", False)):
        path.write_text(
            f'format = 2\nname = "arm"\nextends = ["nasrem"]\n{table}{entry.format(source)}'
        )
        found = [one for one in list_mistakes(path) if one.place == "adapter.lan.export.out.from"]
        why = "operator commands stay in their rack; only mailboxes of levels can be exported"
        assert [str(one).endswith(why) for one in found] == [True] * expected
