"""Messages of ROS 2 that the rows of a rack's rings become, encoded as CDR.

| ring | topic | type |
|---|---|---|
| status of the level that drives the arm | `/joint_states` | `sensor_msgs/msg/JointState` |
| state of the arm | `/tf` | `tf2_msgs/msg/TFMessage` |
| trace of a task | `/diagnostics` | `diagnostic_msgs/msg/DiagnosticArray` |
| status of a board | `/rack/BOARD/status` | `diagnostic_msgs/msg/DiagnosticStatus` |
| events of the run | `/rosout` | `rcl_interfaces/msg/Log` |

Every status of the arm becomes a message of `/joint_states` with the same numbers. Poses and
statuses of boards are sent every 20 ms, diagnostics every second. Frames are the bodies of the
model, in the frame `world`. Time stamps are simulated time, counted from `epoch_ns`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_typestore

from rack.backplane.layout import Layout, MailboxSpec, TaskSpec
from rack.backplane.trace import Flag
from rack.boards.config import RackConfig
from rack.boards.config.cell import build_rack_cell
from rack.boards.timing.trace_times import compute_response_ns, count_misses_and_skips
from rack.levels import RobotConfig
from rack.levels.messages import ArmState
from rack.levels.systems.joint_boards.messages import DRIVING
from rack.tools.console.answer import Document
from rack.tools.recording.signal import list_signals

if TYPE_CHECKING:
    import mujoco

    from rack.levels.robot.cell import Cell

STORE = get_typestore(Stores.ROS2_JAZZY)
"""Types of ROS 2 Jazzy. Others may be registered."""
WORLD = "world"
STATUS_S = 0.02
"""Simulated time between two poses, or between two statuses of a board."""
DIAGNOSTICS_S = 1.0
"""Simulated time that an entry of the diagnostics covers."""
JOINT_FIELDS = (("position", "opening"), ("velocity", "opening_velocity"), ("torque", "grip_force"))
"""Fields of the joints, and of the gripper, for each field of a `JointState`."""
OK, WARN, ERROR = 0, 1, 2
"""Levels of a `DiagnosticStatus`."""
STATE_LEVELS = {"holding": WARN, "error": ERROR}
"""Level of each state of a board. Other states are `OK`."""
SEVERITIES = {"fault": 30, "detection": 30, "miss": 30, "died": 40}
"""Severity of each kind of event in a `Log`. Other events are of severity 20, "info"."""

Rows = np.ndarray
Converter = Callable[[Any], Iterator[tuple[int, Any]]]
"""Converts rows to messages of `STORE`, each with its tick, oldest first."""


class RosTopic(NamedTuple):
    """A topic: its name, and the name of its type."""

    name: str
    type_name: str


class RosSource(NamedTuple):
    """A topic, and the ring (task or mailbox) whose rows become its messages."""

    ring: str
    topic: RosTopic
    convert: Converter


class RosMessage(NamedTuple):
    """An encoded message: its time in ns, its topic, and its CDR with the encapsulation header."""

    time_ns: int
    topic: RosTopic
    data: memoryview


class RosEncoder:
    """Encodes the rows of a rack's rings as ROS messages.

    Args:
        layout: Layout of the rack.
        config: Its config.
        epoch_ns: Time stamp of tick 0.

    Attributes:
        sources: Topics with their rings. Several sources may have the same topic or ring.
        log: The topic of the events, given as in events.jsonl. It has no ring.
    """

    def __init__(self, layout: Layout, config: RackConfig, epoch_ns: int = 0) -> None:
        self._layout = layout
        self._epoch_ns = epoch_ns
        self.sources = [*self._list_sources(config)]
        log = RosTopic("/rosout", "rcl_interfaces/msg/Log")
        self.log = RosSource("", log, self._convert_events)

    def _list_sources(self, config: RackConfig) -> Iterator[RosSource]:
        """Yield the sources of tasks, then those of mailboxes."""
        for task in self._layout.tasks:
            topic = RosTopic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
            yield RosSource(task.name, topic, partial(self._convert_cycles, task))
        for box in self._layout.timed:
            board = box.name.removesuffix(".status")
            if board != box.name and {"state", "error", "reason"} <= {f.name for f in box.fields}:
                topic = RosTopic(
                    f"/rack/{convert_name(board)}/status", "diagnostic_msgs/msg/DiagnosticStatus"
                )
                yield RosSource(box.name, topic, partial(self._convert_status, box))
            if config.robot is not None and box.message in DRIVING:
                topic = RosTopic("/joint_states", "sensor_msgs/msg/JointState")
                yield RosSource(box.name, topic, partial(self._convert_joints, config.robot))
            if config.robot is not None and box.message == ArmState.message_type.name:
                topic = RosTopic("/tf", "tf2_msgs/msg/TFMessage")
                cell = build_rack_cell(config)
                yield RosSource(box.name, topic, partial(self._convert_poses, cell))

    def encode(self, source: RosSource, rows: Any) -> Iterator[RosMessage]:
        """Yield the messages that rows of the source's ring, or events, become, oldest first."""
        for tick, message in source.convert(rows):
            data = STORE.serialize_cdr(message, source.topic.type_name)
            yield RosMessage(self.compute_time(tick), source.topic, data)

    def compute_time(self, tick: int) -> int:
        """Return the time stamp of a tick, in ns."""
        return self._epoch_ns + tick * self._layout.clock_ns

    def build_header(self, tick: int, frame: str = "") -> Any:
        """Return a `std_msgs/msg/Header` with the time stamp of a tick."""
        stamp = build("builtin_interfaces/msg/Time", *divmod(self.compute_time(tick), 10**9))
        return build("std_msgs/msg/Header", stamp, frame)

    def _convert_events(self, events: Iterable[Document]) -> Iterator[tuple[int, Any]]:
        """Yield a `Log` for each event of the run."""
        for event in events:
            # The tick of events before the run is -1.
            tick, kind = max(0, event["tick"]), event["kind"]
            source = event["board"] or self._layout.rack
            text = f"{kind}: {event['text']}"
            head = self.build_header(tick).stamp, SEVERITIES.get(kind, 20)
            yield tick, build(self.log.topic.type_name, *head, source, text, "", event["code"], 0)

    def _convert_joints(self, robot: RobotConfig, rows: Rows) -> Iterator[tuple[int, Any]]:
        """Yield a `JointState` for each status of the arm. The gripper's joint comes last."""
        gripper = robot.gripper
        names = [*robot.joints, *([] if gripper is None else [gripper.joint])]
        columns = [
            np.column_stack([rows["message"][name] for name in group])[:, : len(names)]
            for group in JOINT_FIELDS
        ]
        for tick, *values in zip(rows["tick"].tolist(), *columns, strict=True):
            header = self.build_header(tick)
            yield tick, build("sensor_msgs/msg/JointState", header, names, *values)

    def _convert_poses(self, cell: Cell, rows: Rows) -> Iterator[tuple[int, Any]]:
        """Yield the poses of all bodies in the world, computed from states of the arm."""
        import mujoco

        from rack.levels.robot.engine import view_state

        model, data = cell.model, cell.build_start_data()
        _, *frames = list_frames(model)
        for row in self._select_rows(rows):
            view_state(model, data, row["message"]["state"])
            mujoco.mj_kinematics(model, data)
            tick = int(row["tick"])
            header = self.build_header(tick, WORLD)
            transforms = []
            poses = zip(frames, data.xpos[1:].tolist(), data.xquat[1:].tolist(), strict=True)
            for frame, position, (w, x, y, z) in poses:
                place = build("geometry_msgs/msg/Vector3", *position)
                turn = build("geometry_msgs/msg/Quaternion", x, y, z, w)
                pose = build("geometry_msgs/msg/Transform", place, turn)
                transforms.append(build("geometry_msgs/msg/TransformStamped", header, frame, pose))
            yield tick, build("tf2_msgs/msg/TFMessage", transforms)

    def _convert_status(self, box: MailboxSpec, rows: Rows) -> Iterator[tuple[int, Any]]:
        """Yield the state of a board with all single numbers of its status."""
        rows = self._select_rows(rows)
        signals = [signal for signal in list_signals(box) if not signal.shape]
        names = [".".join(signal.path) for signal in signals]
        columns = [signal.extract_plain(rows["message"]) for signal in signals]
        for tick, *values in zip(rows["tick"].tolist(), *columns, strict=True):
            plain = dict(zip(names, values, strict=True))
            level = ERROR if plain["error"] else STATE_LEVELS.get(plain["state"], OK)
            text = f"{plain['state']}: {plain['reason']}".removesuffix(": ")
            yield tick, self._build_status(level, box.writer, text, plain)

    def _convert_cycles(self, task: TaskSpec, rows: Rows) -> Iterator[tuple[int, Any]]:
        """Yield the counts of a task's cycles in each second."""
        borders = np.flatnonzero(np.diff(self._count_intervals(rows, DIAGNOSTICS_S))) + 1
        for cycles in filter(len, np.split(rows, borders)):
            missed, skipped = count_misses_and_skips(cycles)
            broken = np.count_nonzero(cycles["flags"] & (Flag.BUS_ERROR | Flag.CORRUPT))
            level = ERROR if broken else WARN if missed or skipped else OK
            text = f"{missed} missed, {skipped} skipped of {len(cycles)} cycles"
            values = {
                "cycles": len(cycles),
                "missed": missed,
                "skipped": skipped,
                "bus_errors": broken,
                "longest_response_ms": round(compute_response_ns(cycles).max() * 1e-6, 6),
                "period_ms": task.every * self._layout.clock_ns * 1e-6,
            }
            status = self._build_status(level, task.name, text, values)
            tick = int(cycles["tick"][-1])
            header = self.build_header(tick)
            yield tick, build("diagnostic_msgs/msg/DiagnosticArray", header, [status])

    def _build_status(self, level: int, task: str, text: str, values: Document) -> Any:
        """Return a `DiagnosticStatus`.

        Args:
            level: Level of the status.
            task: Task that it describes.
            text: State of the task, readable.
            values: Values by name. Floats keep all their digits.
        """
        rack = self._layout.rack
        pairs = [build("diagnostic_msgs/msg/KeyValue", *map(str, pair)) for pair in values.items()]
        kind = "diagnostic_msgs/msg/DiagnosticStatus"
        return build(kind, level, f"{rack}: {task}", text, rack, pairs)

    def _select_rows(self, rows: Rows) -> Rows:
        """Return the first row in each interval of `STATUS_S`."""
        _, first = np.unique(self._count_intervals(rows, STATUS_S), return_index=True)
        return rows[first]

    def _count_intervals(self, rows: Rows, seconds: float) -> Rows:
        """Return the number of whole intervals of simulated time before each row."""
        return np.asarray(rows["tick"] // max(1, self._layout.to_ticks(seconds)))


def list_frames(model: mujoco.MjModel) -> list[str]:
    """Return the name of the frame of each body."""
    return [WORLD, *(model.body(body).name or f"body_{body}" for body in range(1, model.nbody))]


def build(type_name: str, *values: Any) -> Any:
    """Build a message of `STORE` from the values of its fields, in order."""
    return STORE.types[type_name](*values)


def convert_name(name: str) -> str:
    """Return the name of a board or mailbox as part of a topic: `own.state` is `own/state`."""
    return re.sub(r"[^\w/]", "_", name.replace(".", "/"))
