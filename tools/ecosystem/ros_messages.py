"""Messages of ROS 2 that the rows of a rack's rings become, encoded as CDR.

| ring | topic | type |
|---|---|---|
| status of the level that drives the arm | `/joint_states` | `sensor_msgs/msg/JointState` |
| state of the arm | `/tf` | `tf2_msgs/msg/TFMessage` |
| trace of a task | `/diagnostics` | `diagnostic_msgs/msg/DiagnosticArray` |
| status of a board | `/rack/BOARD/status` | `diagnostic_msgs/msg/DiagnosticStatus` |

A row of `/joint_states` is a message of the level, with the same numbers. Poses and statuses are
sent every 20 ms, diagnostics every second. Frames are the bodies of the model, in the frame
`world`. Time stamps are simulated time, counted from `epoch_ns`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_typestore

from rack.backplane.layout import Layout, MailboxSpec, TaskSpec
from rack.backplane.trace import Flag
from rack.boards.config import RackConfig
from rack.boards.config.cell import build_rack_cell
from rack.boards.timing.trace_times import compute_response_ns, count_misses_and_skips
from rack.levels.messages import ArmState
from rack.levels.systems.joint_boards.messages import DRIVING
from rack.levels.tables import RobotConfig
from rack.tools.recording.signal import list_signals

STORE = get_typestore(Stores.ROS2_JAZZY)
"""Types of ROS 2 Jazzy. Others may be registered."""
WORLD = "world"
STATUS_S = 0.02
"""Simulated time between two poses, or between two statuses of a board."""
DIAGNOSTICS_S = 1.0
"""Simulated time that an entry of the diagnostics covers."""
OK, WARN, ERROR = 0, 1, 2
"""Levels of a `DiagnosticStatus`."""
STATE_LEVELS = {"holding": WARN, "error": ERROR}
"""Level of each state of a board. Other states are `OK`."""

Rows = np.ndarray
Converter = Callable[[Rows], Iterator[tuple[int, Any]]]
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
    """

    def __init__(self, layout: Layout, config: RackConfig, epoch_ns: int = 0) -> None:
        self._layout = layout
        self._epoch_ns = epoch_ns
        self.sources = [
            RosSource(
                task.name,
                RosTopic("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"),
                partial(self._convert_cycles, task),
            )
            for task in layout.tasks
        ]
        for box in layout.timed:
            if box.name.endswith(".status") and {"state", "error", "reason"} <= _list_names(box):
                topic = f"/rack/{convert_name(box.name.removesuffix('.status'))}/status"
                self._add(box, topic, "diagnostic_msgs/msg/DiagnosticStatus", self._convert_status)
            if config.robot is not None and box.message in DRIVING:
                convert = partial(self._convert_joints, config.robot)
                self._add(box, "/joint_states", "sensor_msgs/msg/JointState", convert)
            if config.robot is not None and box.message == ArmState.message_type.name:
                self._add(box, "/tf", "tf2_msgs/msg/TFMessage", self._build_pose_converter(config))

    def _add(
        self,
        box: MailboxSpec,
        topic: str,
        type_name: str,
        convert: Callable[[MailboxSpec, Rows], Iterator[tuple[int, Any]]],
    ) -> None:
        """Add a source whose ring is a mailbox."""
        self.sources.append(RosSource(box.name, RosTopic(topic, type_name), partial(convert, box)))

    def encode(self, source: RosSource, rows: Rows) -> Iterator[RosMessage]:
        """Yield the messages that rows of the source's ring become, oldest first."""
        for tick, message in source.convert(rows):
            yield RosMessage(
                self.compute_time(tick),
                source.topic,
                STORE.serialize_cdr(message, source.topic.type_name),
            )

    def compute_time(self, tick: int) -> int:
        """Return the time stamp of a tick, in ns."""
        return self._epoch_ns + tick * self._layout.clock_ns

    def build_header(self, tick: int, frame: str = "") -> Any:
        """Return a `std_msgs/msg/Header` with the time stamp of a tick."""
        stamp = build("builtin_interfaces/msg/Time", *divmod(self.compute_time(tick), 10**9))
        return build("std_msgs/msg/Header", stamp, frame)

    def _convert_joints(
        self, robot: RobotConfig, box: MailboxSpec, rows: Rows
    ) -> Iterator[tuple[int, Any]]:
        """Yield a `JointState` for each status of the arm. The gripper's joint comes last."""
        fields: Sequence[tuple[str, ...]] = [("position",), ("velocity",), ("torque",)]
        names = [*robot.joints]
        if robot.gripper is not None:
            fields = [
                ("position", "opening"),
                ("velocity", "opening_velocity"),
                ("torque", "grip_force"),
            ]
            names.append(robot.gripper.joint)
        messages = rows["message"]
        columns = [np.column_stack([messages[name] for name in group]) for group in fields]
        for tick, *values in zip(rows["tick"].tolist(), *columns, strict=True):
            header = self.build_header(tick)
            yield tick, build("sensor_msgs/msg/JointState", header, names, *values)

    def _build_pose_converter(
        self, config: RackConfig
    ) -> Callable[[MailboxSpec, Rows], Iterator[tuple[int, Any]]]:
        """Return a function that converts states of the arm to poses of all bodies in the world."""
        import mujoco

        from rack.levels.robot.engine import view_state

        cell = build_rack_cell(config)
        model, data = cell.model, cell.build_start_data()
        frames = [model.body(body).name or f"body_{body}" for body in range(1, model.nbody)]

        def convert(box: MailboxSpec, rows: Rows) -> Iterator[tuple[int, Any]]:
            for row in self._select_rows(rows, STATUS_S):
                view_state(model, data, row["message"]["state"])
                mujoco.mj_kinematics(model, data)
                tick = int(row["tick"])
                header = self.build_header(tick, WORLD)
                poses = zip(frames, data.xpos[1:].tolist(), data.xquat[1:].tolist(), strict=True)
                transforms = [
                    build(
                        "geometry_msgs/msg/TransformStamped",
                        header,
                        frame,
                        build(
                            "geometry_msgs/msg/Transform",
                            build("geometry_msgs/msg/Vector3", *position),
                            build("geometry_msgs/msg/Quaternion", x, y, z, w),
                        ),
                    )
                    for frame, position, (w, x, y, z) in poses
                ]
                yield tick, build("tf2_msgs/msg/TFMessage", transforms)

        return convert

    def _convert_status(self, box: MailboxSpec, rows: Rows) -> Iterator[tuple[int, Any]]:
        """Yield the state of a board with all single numbers of its status."""
        rows = self._select_rows(rows, STATUS_S)
        signals = [signal for signal in list_signals(box) if not signal.shape]
        names = [".".join(signal.path) for signal in signals]
        columns = [signal.extract_plain(rows["message"]) for signal in signals]
        for tick, *values in zip(rows["tick"].tolist(), *columns, strict=True):
            plain = dict(zip(names, values, strict=True))
            state = str(plain["state"])
            level = ERROR if plain["error"] else STATE_LEVELS.get(state, OK)
            text = f"{state}: {plain['reason']}".removesuffix(": ")
            yield tick, self._build_status(level, box.writer, text, plain)

    def _convert_cycles(self, task: TaskSpec, rows: Rows) -> Iterator[tuple[int, Any]]:
        """Yield the counts of a task's cycles for each second."""
        seconds = rows["tick"] // self._count_ticks(DIAGNOSTICS_S)
        for cycles in np.split(rows, np.flatnonzero(np.diff(seconds)) + 1):
            if not len(cycles):
                continue
            missed, skipped = count_misses_and_skips(cycles)
            broken = np.count_nonzero(cycles["flags"] & (Flag.BUS_ERROR | Flag.CORRUPT))
            level = ERROR if broken else WARN if missed or skipped else OK
            longest_ms = round(compute_response_ns(cycles).max() * 1e-6, 6)
            text = f"{missed} missed, {skipped} skipped of {len(cycles)} cycles"
            values = {
                "cycles": len(cycles),
                "missed": missed,
                "skipped": skipped,
                "bus_errors": broken,
                "longest_response_ms": longest_ms,
                "period_ms": task.every * self._layout.clock_ns * 1e-6,
            }
            tick = int(cycles["tick"][-1])
            status = self._build_status(level, task.name, text, values)
            yield (
                tick,
                build("diagnostic_msgs/msg/DiagnosticArray", self.build_header(tick), [status]),
            )

    def _build_status(self, level: int, task: str, text: str, values: dict[str, Any]) -> Any:
        """Return a `DiagnosticStatus`.

        Args:
            level: Level of the status.
            task: Task that it describes.
            text: State of the task, readable.
            values: Values by name. Floats keep all their digits.
        """
        rack = self._layout.rack
        pairs = [build("diagnostic_msgs/msg/KeyValue", *map(str, pair)) for pair in values.items()]
        return build(
            "diagnostic_msgs/msg/DiagnosticStatus", level, f"{rack}: {task}", text, rack, pairs
        )

    def _select_rows(self, rows: Rows, every_s: float) -> Rows:
        """Return the first row in each interval of simulated time."""
        _, first = np.unique(rows["tick"] // self._count_ticks(every_s), return_index=True)
        return rows[first]

    def _count_ticks(self, seconds: float) -> int:
        return max(1, round(seconds * 1e9 / self._layout.clock_ns))


def build(type_name: str, *values: Any) -> Any:
    """Build a message of `STORE` from the values of its fields, in order."""
    return STORE.types[type_name](*values)


def convert_name(name: str) -> str:
    """Return the name of a board or mailbox as part of a topic: `own.state` is `own/state`."""
    return re.sub(r"[^\w/]", "_", name.replace(".", "/"))


def _list_names(box: MailboxSpec) -> set[str]:
    return {field.name for field in box.fields}
