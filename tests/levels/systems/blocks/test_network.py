"""Networks of function blocks: what may be connected to what, and what they compute."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from rack.levels.errors import LevelError
from rack.levels.systems.blocks.executor import BlockStatus, restore_network
from rack.levels.systems.blocks.network import BlockConfig, BlockNetwork, BlockPort

BLOCKS: Mapping[str, BlockConfig] = {
    "slow": BlockConfig(kind="smooth", unit="N m", value=0.1),
    "change": BlockConfig(kind="difference", unit="N m"),
    "size": BlockConfig(kind="magnitude", unit="N m"),
    "past": BlockConfig(kind="delay", unit="N m"),
    "high": BlockConfig(kind="above", unit="N m", value=2.0),
    "any": BlockConfig(kind="either"),
}
WIRES = {
    "slow.input": "arm.torque",
    "change.a": "arm.torque",
    "change.b": "slow.output",
    "size.input": "change.output",
    "past.input": "size.output",
    "high.input": "size.output",
    "any.a": "high.output",
    "any.b": "arm.braked",
    "stop.input": "any.output",
}
SOURCES = {
    "arm.torque": BlockPort("number", "N m"),
    "arm.opening": BlockPort("number", "m"),
    "arm.braked": BlockPort("flag", "1"),
}
PERIOD_S = 0.05
CYCLE = "closes the cycle"
NUMBER = "high.input takes a number in N m"


@pytest.fixture
def network() -> BlockNetwork:
    return BlockNetwork(BLOCKS, WIRES, SOURCES)


@pytest.mark.parametrize(
    ("target", "source", "reason"),
    [
        ("hihg.input", "size.output", "no input 'hihg.input'; did you mean 'high.input'?"),
        ("high.input", "sise.output", "no output 'sise.output'; did you mean 'size.output'?"),
        ("", "", "no input ''; did you mean 'stop.input'?"),
        ("stop.input", "size.output", "stop.input takes a flag; size.output is a number in N m"),
        ("high.input", "arm.opening", f"{NUMBER}; arm.opening is a number in m"),
        ("high.input", "arm.braked", f"{NUMBER}; arm.braked is a flag"),
        (
            "slow.input",
            "size.output",
            "slow.input=size.output closes the cycle slow > size > change > slow; add a delay",
        ),
        ("size.input", "size.output", f"size.input=size.output {CYCLE} size > size; add a delay"),
    ],
)
def test_a_connection_that_is_not_permitted_changes_nothing(
    network: BlockNetwork, target: str, source: str, reason: str
) -> None:
    with pytest.raises(LevelError) as refused:
        network.connect_ports(target, source)
    assert str(refused.value) == reason
    assert network.wires == WIRES
    network.values["arm.torque"] = 10.0
    assert network.compute_blocks(PERIOD_S)


@pytest.mark.parametrize(
    ("blocks", "wires", "reason"),
    [
        (BLOCKS, {}, "stop.input is not connected; inputs: stop.input, slow.input"),
        (BLOCKS, {**WIRES, "x.y": "arm.torque"}, "no input 'x.y'"),
        ({"arm": BLOCKS["past"]}, {}, "a block cannot be called 'arm'"),
        ({"a.b": BLOCKS["past"]}, {}, "a block cannot be called 'a.b'"),
    ],
)
def test_a_config_without_a_connection_or_name_is_refused(
    blocks: Mapping[str, BlockConfig], wires: Mapping[str, str], reason: str
) -> None:
    with pytest.raises(LevelError) as refused:
        BlockNetwork(blocks, wires, SOURCES)
    assert str(refused.value).startswith(reason)


def test_values_pass_all_blocks_in_one_cycle_and_a_delay_in_two(network: BlockNetwork) -> None:
    values = network.values
    values["arm.torque"] = 8.0
    assert network.compute_blocks(PERIOD_S)
    assert [values[f"{name}.output"] for name in BLOCKS] == [4.0, 4.0, 4.0, 4.0, 1.0, 1.0]
    values["arm.torque"] = 0.0
    network.compute_blocks(PERIOD_S)
    assert [values[f"{name}.output"] for name in BLOCKS] == [2.0, -2.0, 2.0, 2.0, 0.0, 0.0]
    # A flag of the arm stops as well.
    values["arm.braked"] = 1.0
    assert network.compute_blocks(PERIOD_S)


def test_another_connection_acts_in_the_next_cycle(network: BlockNetwork) -> None:
    values = network.values
    values["arm.torque"] = 8.0
    network.compute_blocks(PERIOD_S)
    network.connect_ports("change.b", "past.output")
    seen = []
    for _ in range(4):
        network.compute_blocks(PERIOD_S)
        seen.append(values["size.output"])
    # Each value is the torque without the value before it.
    assert seen == [4.0, 4.0, 4.0, 4.0]
    values["arm.torque"] = 5.0
    network.compute_blocks(PERIOD_S)
    network.compute_blocks(PERIOD_S)
    assert values["size.output"] == 4.0


def test_a_restarted_board_continues_from_its_status(network: BlockNetwork) -> None:
    network.connect_ports("change.b", "past.output")
    network.values["arm.torque"] = 8.0
    network.compute_blocks(PERIOD_S)
    status = BlockStatus.zeros({})
    outputs = list(network.outputs)
    for number, name in enumerate(network.results):
        status.values[number] = network.values[name]
    for number, target in enumerate(network.inputs):
        status.wired[number] = outputs.index(network.wires[target])
    restarted = BlockNetwork(BLOCKS, WIRES, SOURCES)
    restore_network(restarted, status)
    assert restarted.wires == network.wires
    for one in (network, restarted):
        one.values["arm.torque"] = 3.0
        one.compute_blocks(PERIOD_S)
    assert restarted.values == network.values
