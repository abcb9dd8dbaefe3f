"""A type checker knows messages, ports and runs in a user's folder, outside the tree."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest

from tests.processes import run_to_end

pytestmark = pytest.mark.thorough

BOUND_S = 110
OWN = '''
import rack
from rack.backplane.message import Status, field
from rack.levels.host_program import Bus, ProgramInput, ProgramOutput, HostProgram
from rack.levels.level import Executor, Input, Inputs, Output, QueuedOutput
from rack.levels.messages import ServoStatus


class PowerStatus(Status, version=1):
    """Power drawn by the arm."""

    power: float = field(unit="W", doc="mechanical power")


class PowerMeter(Executor):
    servo = Input(ServoStatus, "servo.status")
    servos = Inputs(ServoStatus, "below.status")
    status = Output(PowerStatus)
    queue = QueuedOutput(PowerStatus)

    def process(self, tick: int) -> None:
        self.status.power = float(self.servo.message.torque.sum())
        reveal_type(self.servo.message.torque)  # ndarray
        reveal_type(self.servo.is_new)  # bool
        reveal_type(self.servos["a"].message)  # ServoStatus
        reveal_type(self.queue.send())  # bool
        reveal_type(PowerMeter.servo)  # Input[rack.levels.messages.ServoStatus]
        self.status.powr = 1.0  # has no attribute "powr"; maybe "power"?
        self.status.power = "much"  # Incompatible types in assignment
        self.servo.message.torqe  # has no attribute "torqe"
        self.queue.power = 1.0  # has no attribute "power"


class Program(HostProgram):
    servo = ProgramInput(ServoStatus, "below.servo")
    numbers = ProgramOutput(PowerStatus)

    def run(self, bus: Bus) -> None:
        reveal_type(self.servo.read().message)  # ServoStatus
        self.numbers.message.power = 1.0
        self.numbers.message.powr = 1.0  # has no attribute "powr"; maybe "power"?
        reveal_type(self.numbers.send())  # bool


def main() -> None:
    with rack.Rack("nasrem", lockstep=True, settings={"seed": 7}, out="run") as own:
        reveal_type(own.run(3.0))  # Outcome
    reveal_type(rack.open_run("run").signals["servo.status.torque"].values)  # ndarray
    rack.Rak("nasrem")  # has no attribute "Rak"; maybe "Rack"?
'''


def test_a_type_checker_knows_ports_and_messages_of_a_users_level(tmp_path: Path) -> None:
    (tmp_path / "meter.py").write_text(OWN)
    command = [sys.executable, "-m", "mypy", "--strict", "--no-pretty", "meter.py"]
    done = run_to_end(command, BOUND_S, cwd=tmp_path)
    said = dict(re.findall(r"^meter\.py:(\d+): (.*)$", done.stdout, re.MULTILINE))
    expected = {
        str(number): line.partition("  # ")[2]
        for number, line in enumerate(OWN.splitlines(), 1)
        if "  # " in line
    }
    assert said.keys() == expected.keys(), done.stdout + done.stderr
    for number, what in expected.items():
        assert what in said[number]
        is_right = "Revealed type" in said[number]
        assert is_right == ("reveal_type" in OWN.splitlines()[int(number) - 1])
