"""The example `can-arm`: frames, drives and the rack's side of the bus, in simulated time on a bus
within this process; and once in real time, each drive a process."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import can
import numpy as np
import pytest

from rack.backplane.mailbox.protocols import open_observer
from rack.backplane.message import Message, State
from rack.backplane.segment import Segment
from rack.backplane.watch.alarms import Alarm
from rack.backplane.words import Block
from rack.levels.algebra import Array, solve
from rack.levels.arm import DriveState
from rack.levels.errors import LevelError
from rack.levels.messages import Error
from rack.levels.operator import Operation
from rack.levels.robot.cell import build_cell
from rack.levels.robot.dynamics import Dynamics
from rack.levels.tables import SceneConfig
from tests.levels.arms import cell as shipped_cell
from tests.levels.arms import pendulum
from tests.levels.lockstep import CLOCK_NS, Operator
from tests.levels.servo.rig import ServoRig
from tests.processes import RACK, named, own_can_channel, wait_until
from tests.tools.command_line import rack

EXAMPLE = Path(__file__).parent.parent / "configs" / "examples" / "can-arm"
MODULES = ("can_arm", "can_drives", "cable", "drive", "mechanics", "wire")
TICK_S = CLOCK_NS * 1e-9
PATIENCE_TICKS = 4
POLLS = 3
"""Looks of a drive at the bus, a tick."""
START, GOAL = np.array([0.0, 0.5]), np.array([0.6, -0.4])


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Iterator[Any]:
    """The modules of the example, by name; its bus is within this process."""
    monkeypatch.syspath_prepend(EXAMPLE)
    monkeypatch.setenv("CAN_INTERFACE", "virtual")
    monkeypatch.setenv("CAN_CHANNEL", request.node.name)
    modules = SimpleNamespace(**{name: importlib.import_module(name) for name in MODULES})
    open_bus = modules.wire.open_bus
    buses: list[can.BusABC] = []

    def opened() -> can.BusABC:
        buses.append(open_bus())
        return buses[-1]

    monkeypatch.setattr(modules.wire, "open_bus", opened)
    yield modules
    for bus in buses:
        bus.shutdown()
    for name in MODULES:
        sys.modules.pop(name, None)


class Simulated(NamedTuple):
    """A drive in simulated time."""

    cable: Any
    drive: Any


class DrivenRig(ServoRig):
    """A servo level, and the drives of its arm on a bus within this process, all in simulated
    time."""

    def __init__(self, example: Any, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now_s = 1000.0
        monkeypatch.setattr(example.cable, "monotonic", lambda: self.now_s)
        monkeypatch.setattr(example.cable, "time", lambda: self.now_s)
        clock = SimpleNamespace(time=lambda: self.now_s)
        monkeypatch.setattr("can.interfaces.virtual.time", clock)
        sensors = {"resolution": 2e-5, "noise": 1e-5}
        config = pendulum(folder, latency_ticks=3, patience_ms=10.0, sensors=sensors)
        self.cell = build_cell(config, SceneConfig(), CLOCK_NS)
        self.example = example
        self.mechanics = example.mechanics.Mechanics(self.cell, self.now_s)
        super().__init__(config, SceneConfig(), "own", arm="can_arm:CanArm")
        self.operator = Operator(self.rack)
        self.drives = [self.booted(1), self.booted(2)]

    def booted(self, node: int) -> Simulated:
        """Return a drive that has just booted."""
        cable = self.example.cable.Cable(self.example.wire.open_bus(), node)
        joint = self.example.mechanics.Joint(self.mechanics, node - 1)
        times_s = TICK_S, PATIENCE_TICKS * TICK_S
        return Simulated(
            cable, self.example.drive.Drive(node, joint, cable.send, times_s, self.now_s)
        )

    def step(self) -> None:
        super().step()
        for _ in range(POLLS):
            self.now_s += TICK_S / POLLS
            for cable, drive in self.drives:
                cable.receive(drive.take)
                drive.watch(self.now_s, cable.disturbance)

    @property
    def arm(self) -> Any:
        """The rack's side."""
        return self.servo.arm

    @property
    def powers(self) -> list[str]:
        """States of the drives."""
        return [drive.power.name for _, drive in self.drives]

    @property
    def age(self) -> int:
        """Of the newest sample, ticks."""
        return int(self.arm.tick - self.arm.sense().tick)

    def send(self, kind: int, node: int, data: bytes) -> None:
        """Send a frame from elsewhere."""
        with self.example.wire.open_bus() as bus:
            self.example.wire.send(bus, kind, node, data)

    def disturb(self, kind: str, seconds: float, size: float = 0.0) -> int:
        """Disturb the second drive from the next tick on; return that tick."""
        wire = self.example.wire
        data = wire.SPAN.pack(self.example.cable.Disturbance[kind], seconds, size)
        self.send(wire.DISTURB, 2, data)
        self.found.clear()
        return self.rack.tick

    def swing(self, ticks: int) -> list[int]:
        """Run with set points that do not come to rest; return the age of the newest sample at
        each tick."""
        ages = []
        for _ in range(ticks):
            self.run(1, to_and_fro)
            ages.append(self.age)
        return ages

    def after(self, tick: int) -> list[tuple[int, Alarm]]:
        """Return what was found, and how many ticks after `tick`, but for what adds nothing."""
        return [
            (found.tick - tick, found.finding.alarm)
            for found in self.found
            if found.finding.alarm is not Alarm.RE_REFERENCED
        ]


def to_and_fro(time_s: float) -> tuple[Array, Array]:
    """A motion that does not end."""
    way = 0.5 * (GOAL - START)
    return START + way * (1 - np.cos(2.0 * time_s)), way * 2.0 * np.sin(2.0 * time_s)


@pytest.fixture
def rig(example: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> DrivenRig:
    return DrivenRig(example, tmp_path, monkeypatch)


@pytest.fixture
def swinging(rig: DrivenRig) -> DrivenRig:
    """One whose arm moves."""
    rig.swing(300)
    assert rig.alarms() == [Alarm.BRAKES_OPENED]
    return rig


# Frames


def test_a_command_and_a_report_come_out_as_they_went_in(example: Any) -> None:
    wire = example.wire
    torque = np.array([1.5, -800.0, 1e6])
    data = wire.command(7, [wire.Control.SWITCH_ON] * 3, torque)
    assert (len(data), wire.read_tick(data)) == (wire.SIZES[wire.COMMAND], 7)
    orders = np.frombuffer(data, wire.ORDER, 3, wire.TICK.size)
    assert orders["control"].tolist() == [7, 7, 7]
    # The last is beyond the range of the wire.
    assert (orders["torque"] * wire.UNIT).tolist() == [1.5, -800.0, wire.MOST * wire.UNIT]
    report = wire.Report(9, wire.Power.SWITCHED_ON, wire.TOO_HOT, -3_141_592, 5)
    assert wire.Report(*wire.REPORT.unpack(wire.REPORT.pack(*report))) == report


def test_only_whole_frames_of_known_kinds_come_in(example: Any) -> None:
    wire = example.wire
    with wire.open_bus() as here, wire.open_bus() as there:
        for identifier, data in ((0x080, b"abc"), (0x181, b"short"), (0x321, bytes(8))):
            there.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
        there.send(can.Message(arbitration_id=0x181, data=bytes(16), is_fd=True))  # extended
        wire.send(there, wire.STATUS, 5, bytes(16))
        assert [frame[:3] for frame in wire.receive(here)] == [(wire.STATUS, 5, bytes(16))]


def test_a_bus_that_cannot_be_opened_is_one_line(
    example: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CAN_INTERFACE", "udp_multicast")
    monkeypatch.setenv("CAN_CHANNEL", "10.0.0.1")
    with pytest.raises(LevelError, match=r"^cannot open the bus 10\.0\.0\.1: [^\n]+$"):
        example.wire.open_bus()


def test_without_python_can_one_line_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(EXAMPLE)
    monkeypatch.setitem(sys.modules, "can", None)
    with pytest.raises(LevelError, match=r"needs python-can: pip install 'nasrem-rack\[can\]'$"):
        importlib.import_module("wire")
    assert "wire" not in sys.modules


@pytest.mark.slow
def test_a_drive_takes_no_frame_of_another_node_for_the_racks(example: Any, rig: DrivenRig) -> None:
    wire = example.wire
    rig.run(5)
    before = rig.arm.sense().tick
    rig.rack.lose("servo", 100)
    # CANopen's emergency object of node 2, and a command of its own.
    for kind in (wire.SYNC, wire.COMMAND):
        rig.send(kind, 2, bytes(64))
    with wire.open_bus() as bus:
        rig.step()
        assert {frame.kind for frame in wire.receive(bus)} <= {wire.HEARTBEAT}
    assert before == rig.arm.sense().tick


# Drives


@pytest.mark.parametrize(
    ("power", "word", "then"),
    [
        ("SWITCH_ON_DISABLED", "SHUT_DOWN", "READY_TO_SWITCH_ON"),
        ("READY_TO_SWITCH_ON", "SWITCH_ON", "SWITCHED_ON"),
        ("SWITCHED_ON", "ENABLE_OPERATION", "OPERATION_ENABLED"),
        ("OPERATION_ENABLED", "ENABLE_OPERATION", "OPERATION_ENABLED"),
        ("OPERATION_ENABLED", "SWITCH_ON", "SWITCHED_ON"),
        ("OPERATION_ENABLED", "SHUT_DOWN", "READY_TO_SWITCH_ON"),
        ("OPERATION_ENABLED", "DISABLE_VOLTAGE", "SWITCH_ON_DISABLED"),
        ("OPERATION_ENABLED", "RESET_FAULT", "OPERATION_ENABLED"),
        ("SWITCH_ON_DISABLED", "SWITCH_ON", "SWITCH_ON_DISABLED"),
        ("SWITCH_ON_DISABLED", "ENABLE_OPERATION", "SWITCH_ON_DISABLED"),
        ("READY_TO_SWITCH_ON", "ENABLE_OPERATION", "READY_TO_SWITCH_ON"),
        ("FAULT", "ENABLE_OPERATION", "FAULT"),
        ("FAULT", "DISABLE_VOLTAGE", "FAULT"),
        ("FAULT", "RESET_FAULT", "SWITCH_ON_DISABLED"),
    ],
)
def test_a_drive_changes_its_state_by_commands(
    example: Any, power: str, word: str, then: str
) -> None:
    wire = example.wire
    assert example.drive.next_power(wire.Power[power], wire.Control[word]).name == then


def test_a_clock_sees_through_syncs_that_come_late(example: Any) -> None:
    clock = example.drive.TickClock(0.002)
    late = [0.0, 0.0007, 0.004, 0.0, 0.0001]
    times = [clock.at(tick, 10.0 + 0.002 * tick + late_s) for tick, late_s in enumerate(late)]
    assert times == pytest.approx([10.0, 10.002, 10.004, 10.006, 10.008], abs=1e-6)
    # Very late, or of another run: believed, until one comes earlier.
    assert clock.at(5, 10.110) == pytest.approx(10.110, abs=1e-6)
    assert clock.at(6, 10.012) == pytest.approx(10.012, abs=1e-6)


@pytest.mark.slow
def test_joints_stepped_apart_move_as_the_whole_arm_does(example: Any) -> None:
    cell = shipped_cell("k1607")
    dynamics = Dynamics(cell)
    random = np.random.default_rng(3)
    mechanics = example.mechanics.Mechanics(cell, 0.0)
    joints = [example.mechanics.Joint(mechanics, number) for number in range(7)]
    position, velocity = cell.home.copy(), np.zeros(7)
    for tick in range(500):
        inertia, bias = dynamics.terms(position, velocity)
        swing = np.sin(0.01 * tick + np.arange(7))
        torque = bias + inertia @ (swing - 2.0 * velocity)
        # Commands come some time after the tick, and drives look at them one after the other.
        for number in random.permutation(7):
            joints[number].advance(tick * 2e-3)
            joints[number].drive(torque)
        for _ in range(20):
            inertia, bias = dynamics.terms(position, velocity)
            velocity += 1e-4 * solve(inertia, torque - bias - dynamics.friction(velocity))
            position += 1e-4 * velocity
    for joint in joints:
        joint.advance(1.0)
    assert np.abs(position - cell.home).max() > 0.1
    assert np.abs(mechanics.position - position).max() < 2e-3


# The arm


def test_drives_are_switched_on_step_by_step_and_follow(rig: DrivenRig) -> None:
    seen = []
    for _ in range(12):
        rig.run(1)
        seen.append((rig.arm.state.name, rig.powers[0]))
    assert list(dict.fromkeys(seen)) == [
        ("ENABLING", "SWITCH_ON_DISABLED"),
        ("ENABLING", "READY_TO_SWITCH_ON"),
        ("ENABLING", "SWITCHED_ON"),
        ("ENABLED", "OPERATION_ENABLED"),
    ]
    ages = rig.swing(600)
    assert set(ages) == {1}
    assert rig.alarms() == [Alarm.BRAKES_OPENED]
    assert np.abs(np.array(rig.positions) - np.array(rig.targets)).max() < 2e-4


@pytest.mark.slow
def test_a_disabled_arm_stays_where_it_is_and_goes_on_when_enabled(swinging: DrivenRig) -> None:
    rig = swinging
    rig.operator.say("servo", Operation.DISABLE)
    rig.swing(80)
    assert (rig.arm.state, set(rig.powers)) == (DriveState.DISABLED, {"SWITCH_ON_DISABLED"})
    rest = rig.mechanics.position.copy()
    rig.swing(100)
    assert (rig.mechanics.position == rest).all()
    rig.operator.say("servo", Operation.ENABLE)
    rig.swing(20)
    assert (rig.arm.state, rig.status.braked) == (DriveState.ENABLED, 0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seconds", "size", "found", "age"),
    [
        ("UNPLUGGED", 0.1, 0.0, [(3, Alarm.SENSOR_SILENT), (3, Alarm.BRAKES_CLOSED)], 42),
        ("LATE", 0.2, 0.003, [], 3),
        (
            "LATE",
            0.2,
            0.015,
            [(4, Alarm.SENSOR_SILENT), (4, Alarm.BRAKES_CLOSED), (8, Alarm.SENSOR_LATE)],
            6,
        ),
        ("LOST", 0.25, 0.05, [], 3),
        ("DOUBLED", 0.25, 0.0, [], 1),
    ],
)
def test_after_a_short_trouble_on_the_wire_the_arm_goes_on_by_itself(
    swinging: DrivenRig,
    kind: str,
    seconds: float,
    size: float,
    found: list[tuple[int, Alarm]],
    age: int,
) -> None:
    rig = swinging
    since = rig.disturb(kind, seconds, size)
    ages = rig.swing(200)
    brakings = len(found) > 0
    assert rig.after(since)[: len(found)] == found
    assert len(rig.after(since)) == len(found) + brakings
    assert max(ages) <= age
    assert (rig.arm.fault, rig.status.braked, rig.status.violations) == ("", 0, 0)
    assert rig.powers == ["OPERATION_ENABLED"] * 2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "seconds", "within", "fault"),
    [
        ("UNPLUGGED", 0.8, 205, "drive 2: no heartbeat"),
        ("BUS_OFF", 0.05, 25, "drive 2: was off the bus (0x8140)"),
        ("TOO_HOT", 0.05, 5, "drive 2: too hot (0x4310)"),
        ("RESET", 0.0, 5, "drive 2: has lost its power"),
    ],
)
def test_after_a_fault_of_a_drive_the_arm_waits_for_its_operator(
    swinging: DrivenRig, kind: str, seconds: float, within: int, fault: str
) -> None:
    rig = swinging
    if kind == "RESET":
        rig.drives[1] = rig.booted(2)
    else:
        rig.disturb(kind, seconds)
    rig.swing(within)
    assert (rig.arm.state, rig.arm.fault, rig.status.braked) == (DriveState.FAULT, fault, 1)
    assert (rig.status.error, fault in rig.status.reason) == (Error.DRIVES, True)
    rig.swing(200)
    assert rig.powers[0] == "SWITCH_ON_DISABLED"
    assert np.abs(rig.mechanics.velocity).max() < 1e-9
    rig.operator.say("servo", Operation.RESET)
    rig.swing(20)
    assert (rig.arm.state, rig.arm.fault) == (DriveState.DISABLED, "")
    assert set(rig.powers) == {"SWITCH_ON_DISABLED"}
    rig.operator.say("servo", Operation.ENABLE)
    rig.swing(40)
    assert (rig.arm.state, rig.status.braked) == (DriveState.ENABLED, 0)
    assert rig.status.violations == 0


@pytest.mark.slow
def test_a_reset_without_a_fault_changes_nothing(swinging: DrivenRig) -> None:
    rig = swinging
    rig.operator.say("servo", Operation.RESET)
    rig.swing(20)
    assert rig.alarms() == [Alarm.BRAKES_OPENED]
    # Nor does one that has just helped hide the next fault.
    rig.disturb("TOO_HOT", 0.02)
    rig.swing(20)
    rig.operator.say("servo", Operation.RESET)
    rig.swing(20)
    rig.operator.say("servo", Operation.ENABLE)
    rig.swing(20)
    assert rig.arm.state is DriveState.ENABLED
    rig.drives[1] = rig.booted(2)
    rig.swing(20)
    assert rig.arm.fault == "drive 2: has lost its power"


@pytest.mark.slow
def test_drives_brake_when_the_rack_says_nothing(swinging: DrivenRig) -> None:
    rig = swinging
    rig.rack.lose("servo", 30)
    seen = []
    for _ in range(30):
        rig.step()
        seen.append(rig.powers[0])
    # The last command is of the tick before.
    assert seen.index("SWITCHED_ON") + 1 in (PATIENCE_TICKS - 1, PATIENCE_TICKS)
    rig.swing(60)
    assert (rig.powers[0], rig.status.braked, rig.arm.fault) == ("OPERATION_ENABLED", 0, "")


@pytest.mark.slow
def test_drives_that_miss_the_racks_heartbeat_are_at_fault(swinging: DrivenRig) -> None:
    rig = swinging
    rig.rack.lose("servo", 240)
    for _ in range(240):
        rig.step()
    assert set(rig.powers) == {"FAULT"}
    rig.swing(5)
    assert rig.arm.fault == "drive 1: no heartbeat from the rack (0x8130)"


@pytest.mark.slow
def test_a_restarted_board_finds_the_drives_where_they_are(swinging: DrivenRig) -> None:
    rig = swinging
    rig.restart()
    # It brakes before the first report of a drive comes.
    rig.step()
    rig.arm.brake()
    assert rig.swing(60)[-1] == 1
    assert (rig.arm.state, rig.status.braked, rig.arm.fault) == (DriveState.ENABLED, 0, "")


@pytest.mark.slow
def test_drives_that_do_not_answer_are_a_fault_after_a_while(rig: DrivenRig) -> None:
    rig.drives.pop()
    rig.run(int(5.6 / TICK_S))
    assert (rig.arm.state, rig.arm.fault) == (DriveState.FAULT, "drive 2: no heartbeat")


@pytest.mark.slow
def test_an_arm_is_not_enabled_on_what_a_drive_reported_once(swinging: DrivenRig) -> None:
    rig = swinging
    rig.disturb("UNPLUGGED", 60.0)
    rig.swing(210)
    assert rig.arm.fault == "drive 2: no heartbeat"
    rig.operator.say("servo", Operation.RESET)
    rig.swing(10)
    rig.operator.say("servo", Operation.ENABLE)
    rig.swing(100)
    assert (rig.arm.state, rig.powers[0]) == (DriveState.ENABLING, "SWITCHED_ON")


@pytest.mark.slow
def test_a_bus_that_babbles_does_not_lengthen_a_cycle(swinging: DrivenRig) -> None:
    rig = swinging
    wire = rig.example.wire
    with wire.open_bus() as bus:
        for _ in range(500):
            wire.send(bus, wire.HEARTBEAT, 99, b"\5")
        assert len(list(wire.receive(rig.arm._bus))) == wire.MOST_FRAMES
    rig.swing(100)
    assert (rig.arm.fault, rig.status.braked) == ("", 0)


@pytest.mark.slow
def test_reports_from_another_run_are_no_samples(swinging: DrivenRig) -> None:
    rig = swinging
    wire = rig.example.wire
    for tick in (rig.arm.tick + 1000, 3):
        strange = wire.Report(tick, wire.Power.OPERATION_ENABLED, 0, 10**6, 0)
        rig.send(wire.STATUS, 1, wire.REPORT.pack(*strange))
        rig.swing(1)
        assert rig.arm.sense().position[0] != 1.0
        assert rig.age == 1


# In real time

AT_200_HZ = (
    "clock.period_ms=5",
    "board.servo.rate_hz=200",
    "board.servo.within_cycles=4",
    "board.servo.params.patience=60",
    "robot.patience_ms=25",
)
"""On two slow cores, seven drives and the rack: at 500 Hz the arm was never enabled there."""


def drives_of(channel: str) -> dict[int, int]:
    """Return the processes of the drives on a bus, by node."""
    found = {}
    for pid in named("drive "):
        with suppress(FileNotFoundError, ProcessLookupError):
            if channel.encode() in Path(f"/proc/{pid}/environ").read_bytes():
                found[int(Path(f"/proc/{pid}/comm").read_text().split()[1])] = pid
    return found


@pytest.mark.slow
@pytest.mark.alone
@pytest.mark.thorough
def test_killed_drive_board_and_launcher_leave_an_arm_that_is_braked(
    monkeypatch: pytest.MonkeyPatch, rack_name: str
) -> None:
    channel = own_can_channel()
    monkeypatch.setenv("CAN_CHANNEL", channel)
    # A machine that is busy must not use the restarts up.
    settings = [f"name={rack_name}", "supervision.restarts=1000", *AT_200_HZ]
    words = [word for setting in settings for word in ("--set", setting)]
    command = [*RACK, "run", str(EXAMPLE / "can-arm.toml"), "--no-record", "--share", *words]

    def servo() -> Message:
        return open_observer(Segment.attach(rack_name), "servo.status").peek().value

    launcher = subprocess.Popen(command, stdout=subprocess.DEVNULL)
    try:
        wait_until(lambda: len(drives_of(channel)) == 7, 60.0)
        wait_until(lambda: servo().state == State.EXECUTING, 60.0)
        os.kill(drives_of(channel)[3], signal.SIGKILL)
        wait_until(lambda: "drive 3: has lost its power" in servo().reason)
        assert servo().braked
        wait_until(lambda: 3 in drives_of(channel))
        assert rack("command", rack_name, "servo", "reset", "--wait").returncode == 0
        assert rack("command", rack_name, "servo", "enable", "--wait").returncode == 0
        wait_until(lambda: not servo().braked)
        board = Segment.attach(rack_name).block("servo")
        before = board[Block.PID]
        os.kill(before, signal.SIGKILL)
        wait_until(lambda: board[Block.PID] not in (0, before), 60.0)
        # On a busy machine the drives have missed its heartbeat for too long.
        silent = "no heartbeat from the rack"
        wait_until(lambda: servo().state == State.EXECUTING or silent in servo().reason, 60.0)
    finally:
        launcher.kill()
        launcher.wait()
    wait_until(lambda: not drives_of(channel))
    assert rack("clean").returncode == 0
