"""A board that runs a network of function blocks, and a motion that the network can stop.

    rack set ibm 'board.blocks.params.wire="high.input=arm.torque.j3"'

connects the input of a block to another output between two cycles. The board checks type and unit,
and refuses a connection with the reason.
"""

from __future__ import annotations

import numpy as np

from rack.backplane.message import AnyMessage, State, field
from rack.levels.errors import LevelError
from rack.levels.level import Executor, Input, LevelContext, Mismatches, Output
from rack.levels.operator import AnsweringStatus, OperatorCommand
from rack.levels.systems.blocks.network import STOP, BlockConfig, BlockNetwork, BlockPort
from rack.levels.systems.joint_boards.messages import ArmStatus
from rack.levels.systems.trajectory import TrajectoryExecutor
from rack.levels.systems.trajectory.messages import MotionKind
from rack.levels.tables import Live, Table, read_params

SETTLE_S = 0.3
"""Time after a braking in which `stop` is not set."""
MAX_PORTS = 32
"""Largest number of inputs, and of blocks, of a network."""


class BlockParams(Table):
    """`[board.<name>.params]`: blocks and their connections."""

    block: dict[str, BlockConfig]
    """blocks, by name"""
    wires: dict[str, str]
    """output connected to each input at the launch, by input"""
    wire: Live[str] = ""
    """connection to make while the rack runs, INPUT=OUTPUT"""


class BlockStatus(AnsweringStatus, version=1):
    """Sent by a board of function blocks."""

    stop: bool = field(doc="1: `stop.input` is set")
    values: np.ndarray = field(
        unit="of the block", doc="outputs of the blocks, as in the config", shape=MAX_PORTS
    )
    wired: np.ndarray = field(
        "u2", unit="1", doc="for each input, the number of its output", shape=MAX_PORTS
    )


def build_network(context: LevelContext) -> BlockNetwork:
    """Return the network of a board. Raises `LevelError` if a connection is not permitted."""
    params = read_params(BlockParams, context.params)
    sources: dict[str, BlockPort] = {}
    for declared in ArmStatus.message_type.fields:
        if declared.python in (bool, float, np.ndarray) and declared.kind in ("f8", "u1"):
            port = BlockPort("flag" if declared.python is bool else "number", str(declared.unit))
            joints = context.robot.joints if declared.shape == ("joints",) else ()
            names = [f"arm.{declared.name}.{joint}" for joint in joints]
            sources |= dict.fromkeys(names or [f"arm.{declared.name}"], port)
    network = BlockNetwork(params.block, params.wires, sources)
    if len(network.inputs) > MAX_PORTS:
        raise LevelError(f"{len(network.inputs)} inputs; at most {MAX_PORTS} are possible")
    return network


class BlockExecutor(Executor):
    """Runs a network of function blocks on what the arm senses."""

    arm = Input(ArmStatus, "arm.status")
    last_status = Input(BlockStatus, "own.status")
    status = Output(BlockStatus, rests_on=arm)
    params = BlockParams
    settings: BlockParams

    def __init__(self, context: LevelContext) -> None:
        super().__init__(context)
        self.network = build_network(context)
        self._is_restored = False
        self._settled_tick = 0

    @classmethod
    def find_mismatches(cls, context: LevelContext) -> Mismatches:
        """Yield a connection that is not permitted. See `Executor.find_mismatches`."""
        try:
            build_network(context)
        except LevelError as error:
            yield "params.wires", dict(context.params["wires"]), str(error)

    def take_settings(self, tick: int) -> None:
        """Make the connections that the operator commands, after those before a restart."""
        last = self.last_status
        if not self._is_restored and last.has_message:
            restore_network(self.network, last.message)
        self._is_restored = True
        super().take_settings(tick)

    def process(self, tick: int) -> None:
        """Compute all blocks once."""
        network = self.network
        record = self.arm.message.record
        for source in set(network.wires.values()):
            port, name, joint = (*source.split("."), "")[:3]
            if port == "arm" and name != "output":
                joints = self.context.robot.joints
                value = record[name][joints.index(joint)] if joint else record[name]
                network.values[source] = float(value)
        status = self.status
        if self.arm.message.braked:
            self._settled_tick = tick + round(SETTLE_S / self.context.tick_s)
        # The brakes change the torques, too, which is no touch.
        status.stop = network.compute_blocks(self.context.period_s) and tick >= self._settled_tick
        for number, name in enumerate(network.results):
            status.values[number] = network.values[name]
        outputs = list(network.outputs)
        for number, target in enumerate(network.inputs):
            status.wired[number] = outputs.index(network.wires[target])
        status.state = State.EXECUTING

    def _set_parameter(self, command: OperatorCommand) -> None:
        """Make the connection that a command names, or refuse the command with the reason."""
        before = self.settings
        super()._set_parameter(command)
        if self.settings is not before:
            try:
                target, _, source = self.settings.wire.partition("=")
                self.network.connect_ports(target.strip(), source.strip())
            except LevelError as error:
                self.settings = before
                self._orders.refuse_newest(str(error))


def restore_network(network: BlockNetwork, status: BlockStatus | AnyMessage) -> None:
    """Give a network the connections and values in a status."""
    network.values |= zip(network.results, status.values.tolist(), strict=False)
    outputs = list(network.outputs)
    network.wires = {
        target: outputs[number]
        for target, number in zip(network.inputs, status.wired.tolist(), strict=False)
    }
    network.connect_ports(STOP, network.wires[STOP])


class WiredMotion(TrajectoryExecutor):
    """A trajectory level whose guarded motions also end when the network of blocks says stop."""

    blocks = Input(BlockStatus, "blocks.status")

    def _check_guard(self, cycles: int) -> None:
        """End the current request if it has a guard, and the torques or the blocks end it."""
        super()._check_guard(cycles)
        current = self._agenda.current
        is_guarded = current is not None and current.kind == MotionKind.POSE and current.touch
        if is_guarded and self.blocks.is_new and self.blocks.message.stop:
            self._work.end_at_guard()
