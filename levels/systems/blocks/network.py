"""Function blocks wired by data flow: each input is connected to one output of its type and unit.

An output is named BLOCK.output, or PORT.FIELD[.JOINT] for a value that another board sends. An
input is named BLOCK.INPUT. The input `stop.input` belongs to the network.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from difflib import get_close_matches
from graphlib import CycleError, TopologicalSorter
from typing import Literal, NamedTuple

from rack.levels.errors import LevelError
from rack.levels.tables import Finite, Table


class BlockPort(NamedTuple):
    """Type and unit of the values at an input or output."""

    type: str
    unit: str

    def __str__(self) -> str:
        return f"a {self.type} in {self.unit}" if self.unit != "1" else f"a {self.type}"


class BlockKind(NamedTuple):
    """Ports of a kind of block, and what it computes."""

    inputs: tuple[str, ...]
    takes: str
    gives: str
    # Computes the output from the previous output, the inputs, the parameter and the period in s.
    compute: Callable[[float, list[float], float, float], float]


KINDS = {
    "smooth": BlockKind(
        ("input",),
        "number",
        "number",
        lambda before, inputs, time_s, period_s: (
            before + (inputs[0] - before) * min(1.0, period_s / max(time_s, period_s))
        ),
    ),
    "difference": BlockKind(
        ("a", "b"), "number", "number", lambda _, inputs, *__: inputs[0] - inputs[1]
    ),
    "magnitude": BlockKind(("input",), "number", "number", lambda _, inputs, *__: abs(inputs[0])),
    "above": BlockKind(
        ("input",), "number", "flag", lambda _, inputs, limit, __: float(inputs[0] > limit)
    ),
    "either": BlockKind(("a", "b"), "flag", "flag", lambda _, inputs, *__: max(inputs)),
    "delay": BlockKind(("input",), "number", "number", lambda _, inputs, *__: inputs[0]),
}
"""Kinds of blocks. A `delay` gives its input of the previous cycle, so it may close a cycle."""
STOP = "stop.input"
RESERVED = ("arm", "stop")
"""Names that no block may have, because ports begin with them."""


class BlockConfig(Table):
    """`[board.<name>.params.block.<block>]`: a function block."""

    kind: Literal["smooth", "difference", "magnitude", "above", "either", "delay"]
    """smooth: first-order low-pass; difference: a - b; magnitude; above: a flag; either: a or b;
    delay: the value one cycle ago"""
    unit: str = "1"
    """unit of the numbers that it takes"""
    value: Finite = 0.0
    """time of a smooth [s], or limit of an above [its unit]"""


class BlockNetwork:
    """Blocks and their connections.

    Args:
        blocks: Blocks by name.
        wires: Output connected to each input.
        sources: Type and unit of each value that comes from another board.

    Attributes:
        blocks: Blocks by name.
        inputs: Type and unit of each input.
        outputs: Type and unit of each output.
        wires: Output connected to each input.
        results: Outputs of the blocks, in their order in the config.
        values: Newest value of each output.

    Raises:
        LevelError: A connection is missing or not permitted.
    """

    def __init__(
        self,
        blocks: Mapping[str, BlockConfig],
        wires: Mapping[str, str],
        sources: Mapping[str, BlockPort],
    ) -> None:
        self.blocks = blocks
        self.outputs = dict(sources)
        self.inputs = {STOP: BlockPort("flag", "1")}
        for name, block in blocks.items():
            if name in RESERVED or not name.isidentifier():
                raise LevelError(f"a block cannot be called '{name}'")
            kind = KINDS[block.kind]
            taken, given = (
                BlockPort(type_, block.unit if type_ == "number" else "1")
                for type_ in (kind.takes, kind.gives)
            )
            self.outputs[f"{name}.output"] = given
            self.inputs |= {f"{name}.{port}": taken for port in kind.inputs}
        self.results = [f"{name}.output" for name in blocks]
        self.values = dict.fromkeys(self.outputs, 0.0)
        if missing := [name for name in self.inputs if name not in wires]:
            raise LevelError(f"{missing[0]} is not connected; inputs: {', '.join(self.inputs)}")
        self.wires: dict[str, str] = {}
        self._order: list[str] = []
        for target, source in wires.items():
            self.connect_ports(target, source)

    def connect_ports(self, target: str, source: str) -> None:
        """Connect an input to another output.

        Args:
            target: The input.
            source: The output.

        Raises:
            LevelError: A port is unknown, type or unit differ, or the blocks would form a cycle
                without a delay. The connections are then unchanged.
        """
        for name, known, what in ((target, self.inputs, "input"), (source, self.outputs, "output")):
            if name not in known:
                near = get_close_matches(name, known, 1) or list(known)[:1]
                raise LevelError(f"no {what} '{name}'; did you mean '{near[0]}'?")
        taken, given = self.inputs[target], self.outputs[source]
        if taken != given:
            raise LevelError(f"{target} takes {taken}; {source} is {given}")
        wires = {**self.wires, target: source}
        before = {
            name: {
                wires[at].partition(".")[0]
                for port in KINDS[block.kind].inputs
                if block.kind != "delay" and (at := f"{name}.{port}") in wires
            }
            for name, block in self.blocks.items()
        }
        try:
            order = [n for n in TopologicalSorter(before).static_order() if n in self.blocks]
            # A delay takes what its source gives in the same cycle.
            self._order = sorted(order, key=lambda name: self.blocks[name].kind == "delay")
        except CycleError as error:
            path = " > ".join(reversed(error.args[1]))
            raise LevelError(f"{target}={source} closes the cycle {path}; add a delay") from None
        self.wires = wires

    def compute_blocks(self, period_s: float) -> bool:
        """Compute all blocks from `values` of the sources. Return the value of `stop.input`."""
        values = self.values
        following: dict[str, float] = {}
        for name in self._order:
            block = self.blocks[name]
            kind = KINDS[block.kind]
            output = f"{name}.output"
            inputs = [values[self.wires[f"{name}.{port}"]] for port in kind.inputs]
            result = kind.compute(values[output], inputs, block.value, period_s)
            # The outputs of delays stand since the previous cycle.
            (following if block.kind == "delay" else values)[output] = result
        is_stopped = bool(values[self.wires[STOP]])
        values.update(following)
        return is_stopped
