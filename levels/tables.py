"""Config tables that levels read: `[robot]`, `[scene]`, and the base of `[board.<name>.params]`.

An arm is data: an MJCF file, and in `[robot]` the rest. `rack.levels.robot` builds the cell from
both.
"""

from __future__ import annotations

import ast
import inspect
from collections import ChainMap
from collections.abc import Iterator, Mapping
from contextlib import suppress
from functools import cache
from itertools import pairwise
from pathlib import Path
from textwrap import dedent
from typing import Annotated, Any, Literal, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic.config import JsonDict
from pydantic.fields import FieldInfo

from rack.backplane.bounded_toml import load_toml
from rack.levels.errors import LevelError
from rack.levels.references import find_class

T = TypeVar("T")

# No quantity of an arm in SI units, and no time of a run, exceeds these: sums and squares of them
# stay finite. pydantic keeps one bound of each kind, so a narrower field uses `le` and `ge`.
MOST = 1e9
MOST_JOINTS = 16
"""Of an arm."""
Positive = Annotated[float, Field(gt=0, lt=MOST, allow_inf_nan=False)]
Finite = Annotated[float, Field(gt=-1e9, lt=1e9, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]
Interface = Literal["torque", "position", "velocity"]
"""What drives take; with the last two they close loops of their own."""
Moment = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
"""Simulated time, s."""
LAST_TICK = 10**15
"""Ticks are 64-bit words: this many of the shortest ones last 300 years."""
Tick = Annotated[int, Field(ge=0, le=LAST_TICK)]


LIVE: JsonDict = {"live": True}
Live = Annotated[T, Field(json_schema_extra=LIVE)]
"""A field of params that an operator may set while the level runs: `gain: Live[Positive] = 2.0`."""


class Table(BaseModel):
    """Base of every config table: unknown keys are errors, values are frozen, `true` does not pass
    for 1.

    A text below a field is its description, with the unit in brackets: "velocity limits [rad/s]".
    See `keys_of`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    @model_validator(mode="before")
    @classmethod
    def _with_tuples(cls, table: Any) -> Any:
        """Turn TOML's lists into tuples, which are frozen."""
        if not isinstance(table, dict):
            return table
        # Dicts of the user's own keys stay as given.
        return {k: v if isinstance(v, dict) else frozen(v) for k, v in table.items()}


def keys_of(kind: type[BaseModel]) -> dict[str, FieldInfo]:
    """Return the fields of a table by their keys, each with its description.

    Where a field has none, that is the text below it. pydantic can look for such texts itself
    (`use_attribute_docstrings`), but does so in every class that is made: each start of a rack
    would take 0.2 s longer.
    """
    below = ChainMap(*(_texts_below(base) for base in kind.__mro__ if issubclass(base, Table)))
    for name, field in kind.model_fields.items():
        field.description = field.description or below.get(name)
    return {field.alias or name: field for name, field in kind.model_fields.items()}


@cache
def _texts_below(table: type[Table]) -> dict[str, str]:
    """Return the texts below the fields of a class in its source, by field."""
    found = {}
    with suppress(OSError, TypeError):  # a class typed at a prompt has no source
        (declared,) = ast.parse(dedent(inspect.getsource(table))).body
        assert isinstance(declared, ast.ClassDef)
        for pair in pairwise(declared.body):
            match pair:
                case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                    found[name] = " ".join(text.split())
    return found


def frozen(value: Any) -> Any:
    """Return a value of TOML with tuples in place of all lists in it, also of those in tables."""
    if isinstance(value, dict):
        return {key: frozen(item) for key, item in value.items()}
    return tuple(map(frozen, value)) if isinstance(value, list) else value


Params = TypeVar("Params", bound=Table)


def read_params(kind: type[Params], params: Mapping[str, Any]) -> Params:
    """Return `params` as `kind`. Raises `LevelError` with the key, its value and the valid keys."""
    try:
        return kind(**params)
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        valid = ", ".join(kind.model_fields)
        raise LevelError(
            f"params.{key} = {first['input']!r}: {first['msg'].lower()}; keys: {valid}"
        ) from error


def live_keys(kind: type[Table] | None) -> tuple[str, ...]:
    """Return the params that may be set while their level runs."""
    fields = {} if kind is None else kind.model_fields
    return tuple(key for key, field in fields.items() if field.json_schema_extra == LIVE)


def read_setting(setting: str) -> tuple[str, Any]:
    """Return key and value of "key=value", with the value in TOML. Raises `LevelError`."""
    key, _, text = setting.partition("=")
    try:
        return key.strip(), load_toml(f"value = {text}")["value"]
    except ValueError:  # the parser's own errors are such
        raise LevelError("must be key=value, as in bandwidth=80") from None


def set_live(params: Params, setting: str) -> tuple[Params, str]:
    """Return `params` with a live one set anew by "key=value", and why not; empty: it is set."""
    kind = type(params)
    try:
        key, value = read_setting(setting)
        if key not in (live := live_keys(kind)):
            return params, f"params.{key} is not live; live: {', '.join(live) or 'none'}"
        return read_params(kind, {**dict(params), key: value}), ""
    except LevelError as error:
        return params, str(error)


def named_class(reference: str, base: type[T]) -> type[T]:
    """Return the subclass of `base` that "package.module:Class" names. Raises `ValueError`."""
    try:
        return find_class(reference, base)
    except LookupError as error:
        raise ValueError(str(error)) from error


class SensorConfig(Table):
    """Resolution and noise of the joints' encoders: one value for all joints, or a list with one
    per joint; 0: exact.

    Velocities have ten times as much of both, in rad/s; see `rack.levels.robot.limits.Encoders`.
    """

    resolution: NotNegative | tuple[NotNegative, ...] = 0.0
    """step of a joint position as sensed [rad]"""
    noise: NotNegative | tuple[NotNegative, ...] = 0.0
    """standard deviation of a joint position as sensed [rad]"""


class CalibrationConfig(Table):
    """`[robot.calibration]`: how the drives' samples become positions of the joints."""

    offset: tuple[Finite, ...] | None = None
    """added to every position that the drives give [rad]; default: nothing"""
    homing: bool = False
    """the drives find their reference while they are being enabled, and know no position before
    that"""


DAMPING_S = 0.03
"""Damping of a gripper's loop per stiffness, where none is given."""
STILL_PARTS = 20
"""The opening may be a length or an angle: what counts as no motion is a part of the whole."""


class FollowConfig(Table):
    """`[[robot.gripper.follow]]`: a joint that the gripper moves, though the model couples it to
    nothing. Its own actuator is removed.
    """

    joint: str
    """MJCF joint that follows the driven one"""
    ratio: Finite = 1.0
    """its motion per motion of the driven joint, from the model's reference pose"""


class GripperConfig(Table):
    """A gripper driven by one actuator along one joint."""

    actuator: str
    """MJCF actuator that drives the gripper"""
    joint: str
    """MJCF joint whose position is the opening"""
    open: Finite
    """joint position when open [m or rad]"""
    closed: Finite
    """joint position when closed on nothing [m or rad]"""
    force: Positive
    """largest force or torque of the actuator [N or N m]"""
    stiffness: Positive | None = None
    """position loop [N/m or N m/rad]; default: all of the force at half of the way to closed"""
    damping: Positive | None = None
    """position loop [N s/m or N m s/rad]; default: 30 ms times the stiffness"""
    follow: tuple[FollowConfig, ...] = ()
    """joints that follow the driven one, where the model does not say so"""
    residual: Positive = 0.012
    """how far fingers may settle from where planning poses them, because soft couplings yield, or a
    loop may stay open [m]; by default less than the 15 mm that planned motion keeps from
    everything"""

    @model_validator(mode="after")
    def _opens(self) -> GripperConfig:
        if self.open == self.closed:
            raise ValueError(f"open and closed are both {self.open:g}: the gripper does not move")
        return self

    @property
    def travel(self) -> float:
        """The way of the driven joint from open to closed, m or rad."""
        return abs(self.open - self.closed)

    @property
    def gains(self) -> tuple[float, float]:
        """Stiffness and damping of the position loop, N/m and N s/m, or N m/rad and N m s/rad."""
        stiffness = self.stiffness or 2.0 * self.force / self.travel
        return stiffness, self.damping or DAMPING_S * stiffness

    @property
    def still(self) -> float:
        """Part of that way, m or rad, that counts as none; and in a second, as rest."""
        return self.travel / STILL_PARTS


class WristConfig(Table):
    """`[robot.wrist]`: a force/torque sensor between arm and tool, and the arm's limits on
    contact.
    """

    force: str
    """MJCF force sensor; its cutoff is its range [N]"""
    torque: str
    """MJCF torque sensor at the same site; its cutoff is its range [N m]"""
    most_force: Positive
    """force of a contact at which the arm stops [N]; within the range"""
    most_torque: Positive
    """torque of a contact at which the arm stops [N m]; within the range"""
    noise: NotNegative = 0.0
    """standard deviation of a force as sensed [N]; of a torque a tenth, N m"""


class FingerConfig(Table):
    """`[[robot.hand.finger]]`: one finger."""

    name: str
    """name of the finger"""
    tip: str
    """MJCF site at its tip"""
    joints: tuple[str, ...] = Field(min_length=1)
    """its joints, base to tip; of robot.joints"""


class HandConfig(Table):
    """`[robot.hand]`: a hand whose joints are driven by pairs of tendons, which can only pull. One
    value per joint.
    """

    finger: tuple[FingerConfig, ...] = Field(min_length=1)
    """the fingers"""
    flexors: tuple[str, ...]
    """MJCF actuators on the tendons that turn a joint in positive direction"""
    extensors: tuple[str, ...]
    """MJCF actuators on the tendons that turn it back"""
    least: Positive
    """tension below which a tendon is slack [N]"""
    rest: Positive
    """mean tension of a pair at rest [N]; it stiffens nothing in a linear tendon"""
    closed: NotNegative = 0.0
    """stiffness of a tendon whose valve is closed, by the air in it [N/m]; 0: it keeps its
    tension"""


class ToolConfig(Table):
    """`[robot.tool_offset]`: the tool's frame on a body, for a model without a site for it."""

    position: Vector = (0.0, 0.0, 0.0)
    """of the tool in the body's frame [m]"""
    quaternion: tuple[Finite, Finite, Finite, Finite] = (1.0, 0.0, 0.0, 0.0)
    """of the tool in the body's frame, as w, x, y, z; its z axis approaches"""


class RobotConfig(Table):
    """`[robot]`: an arm, by its MJCF file and the data missing there. Lists have one value per
    joint.
    """

    model: Path = Field(strict=False)
    """MJCF file of the arm and its cell; relative to the config"""
    joints: tuple[str, ...] = Field((), min_length=1, max_length=MOST_JOINTS)
    """MJCF joints of the arm, base to tool; default: those with an actuator, without the
    gripper's"""
    tool: str = Field("", min_length=1)
    """MJCF site whose pose is the tool's, or a body; default: the last site that the arm carries,
    else its last body"""
    tool_offset: ToolConfig | None = None
    """pose of the tool on the body that `tool` names; default: the body's own"""
    home: tuple[Finite, ...] = Field((), min_length=1)
    """joint positions to which tasks return, and the simulated start [rad]; default: those of the
    first keyframe"""
    start: tuple[Finite, ...] | None = None
    """where the simulated arm starts [rad]; default: home"""
    velocity: tuple[Positive, ...]
    """velocity limits [rad/s]"""
    acceleration: tuple[Positive, ...]
    """acceleration limits of planned motion [rad/s2]"""
    jerk: tuple[Positive, ...]
    """jerk limits of planned motion [rad/s3]"""
    torque: tuple[Positive, ...] | None = None
    """torque limits [N m]; default: the model's actuator limits"""
    position: tuple[tuple[Finite, Finite], ...] | None = None
    """position limits [rad]; default: the model's joint ranges"""
    interface: Interface = "torque"
    """what the drives take in every cycle: torques, or set points of position or velocity, which
    they follow by loops of their own; the simulated arm's drives are such, too"""
    exclude: tuple[tuple[str, str], ...] = ()
    """pairs of MJCF bodies whose contacts do not count, beside the model's own"""
    gripper: GripperConfig | None = None
    """gripper, if the arm has one"""
    sensors: SensorConfig | None = None
    """resolution and noise of the joints' encoders; default: exact if they are simulated, 1e-4 and
    5e-5 rad otherwise, see `rack.levels.arm.Arm.sensors`"""
    calibration: CalibrationConfig = CalibrationConfig()
    """from the drives' samples to positions"""
    latency_ticks: int = Field(0, ge=0, le=20)
    """age of the newest sample when a cycle reads it [ticks], as a bus to the drives has it; the
    simulated arm's samples are that old, too"""
    wrist: WristConfig | None = None
    """force/torque sensor, if the arm has one"""
    hand: HandConfig | None = None
    """tendons and fingers, for a hand in place of an arm"""
    patience_ms: Positive | None = Field(None, le=100.0)
    """time without a new torque for which motors keep the last one [ms]; then the brakes engage;
    rounded down to whole torque cycles, at least one; default: by what the arm does in it, see
    `rack check --verbose`"""
    substeps: int = Field(5, ge=1, le=50)
    """MuJoCo steps in one servo cycle"""
    min_armature: Finite = Field(0.05, ge=0)
    """least drive inertia of every joint [kg m2]: light wrists need it"""
    enable: Literal["at-start", "by-command"] | None = None
    """when drives are asked for torque: at the start, or by `rack command RACK servo enable`;
    default: at-start for the simulated arm, by-command for every other"""
    bring_up: Positive | None = Field(None, le=1.0)
    """part of full speed at which the arm moves until `rack command RACK servo release`; default:
    full speed from the start"""
    guessed: tuple[str, ...] = ()
    """keys of this table whose values were guessed, as in gripper.force: an arm that is not
    simulated is not enabled before each is confirmed, by removing it here"""

    def misfits(self) -> Iterator[tuple[str, Any, str]]:
        """Yield key, values and reason for every list without one value per joint."""
        joints = len(self.joints)
        keys = ("home", "start", "velocity", "acceleration", "jerk", "torque", "position")
        lists = {key: getattr(self, key) for key in keys}
        lists["calibration.offset"] = self.calibration.offset
        for key, values in lists.items():
            if values is not None and len(values) != joints:
                yield key, values, f"{len(values)} values; permitted: {joints}, one per joint"
        for key, values in self.sensors or ():
            if isinstance(values, tuple) and len(values) != joints:
                permitted = f"one for all joints, or {joints}, one per joint"
                yield f"sensors.{key}", values, f"{len(values)} values; permitted: {permitted}"

    @field_validator("guessed")
    @classmethod
    def _are_keys(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            if name.partition(".")[0] not in cls.model_fields:
                raise ValueError(f"'{name}' is no key of [robot]; `rack schema robot` lists them")
        return names

    @property
    def tool_name(self) -> str:
        """The site whose pose is the tool's: one that the table places has a name of its own."""
        return self.tool if self.tool_offset is None else f"tool of {self.tool}"


class MotionConfig(Table):
    """A move of an obstacle, a mocap body, which the simulated cell makes at a fixed time."""

    body: str
    """obstacle that moves"""
    at: Moment
    """simulated time when it starts [s]"""
    to: Vector
    """where its origin goes [m]"""
    speed: Positive = 0.25
    """speed along the straight line [m/s]"""


class PushConfig(Table):
    """`[[scene.push]]`: a force on an object, which the simulated cell exerts at a fixed time."""

    body: str
    """object that is pushed"""
    at: Moment
    """simulated time when it begins [s]"""
    seconds: Positive
    """time for which it lasts [s]"""
    force: Vector
    """force at the centre of mass, in the world's frame [N]"""
    rise: NotNegative = 0.0
    """time in which it rises, and in which it falls at its end [s]"""


class GoalConfig(Table):
    """`[[scene.goal]]`: where the task takes an object. A task of transfers states goals by
    itself.
    """

    object: str
    """object that the task moves, or keeps"""
    position: Vector
    """where its origin ends [m]"""
    # A gripper centres a part across its pads, not along them: there it stays as far off as it was
    # taken, or slips.
    tolerance_mm: Positive = 10.0
    """distance from there at which the task still counts as done [mm]"""


class SceneConfig(Table):
    """`[scene]`: objects and obstacles in the cell, by their names in the MJCF."""

    objects: tuple[str, ...] = ()
    """free bodies that tasks may move"""
    obstacles: tuple[str, ...] = ()
    """mocap bodies that may move by themselves"""
    supports: tuple[str, ...] = ()
    """geoms on which objects may stand, and a tool on a wrist sensor may press"""
    clearance: Positive = 0.015
    """distance that planned motion keeps from everything [m]"""
    motion: tuple[MotionConfig, ...] = ()
    """moves of obstacles, by time"""
    push: tuple[PushConfig, ...] = ()
    """forces on objects, by time"""
    goal: tuple[GoalConfig, ...] = ()
    """where objects end, if the task is done"""

    @property
    def bodies(self) -> tuple[str, ...]:
        """Objects, then obstacles: the order of the world model's rows."""
        return self.objects + self.obstacles
