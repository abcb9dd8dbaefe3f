"""Config tables that levels read: `[robot]`, `[scene]`, and the base of `[board.<name>.params]`.

An arm is data: an MJCF file describes it, and `[robot]` adds the rest. `rack.levels.robot` builds
the cell from both.
"""

from __future__ import annotations

import ast
import inspect
from collections import ChainMap
from collections.abc import Callable, Iterable, Iterator, Mapping
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
    StringConstraints,
    ValidationError,
    field_validator,
    model_validator,
)
from pydantic.config import JsonDict
from pydantic.fields import FieldInfo

from rack.backplane.bounded_toml import load_toml
from rack.backplane.rack_name import RACK_NAME
from rack.levels.errors import LevelError, ProgramError
from rack.levels.references import find_class

T = TypeVar("T")

MAX_VALUE = 1e9
"""Bound of all quantities of an arm in SI units, and of all times of a run.

Sums and squares of such values stay finite. pydantic keeps one bound of each kind, so a field with
narrower bounds uses `le` and `ge`."""
MAX_JOINTS = 16
"""Maximum number of joints of an arm."""
Positive = Annotated[float, Field(gt=0, lt=MAX_VALUE, allow_inf_nan=False)]
Finite = Annotated[float, Field(gt=-1e9, lt=1e9, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]
Quaternion = tuple[Finite, Finite, Finite, Finite]
RackName = Annotated[str, StringConstraints(pattern=f"^{RACK_NAME}$")]
MailboxName = Annotated[str, StringConstraints(pattern=r"^[a-z][a-z0-9_]*\.[a-z][a-z0-9_]*$")]
ClassName = Annotated[str, StringConstraints(pattern=r"^[A-Za-z_][\w.]*:[A-Za-z_]\w*$")]
Interface = Literal["torque", "position", "velocity"]
"""Commands that drives accept.

Drives that accept positions or velocities close their control loops themselves.
"""
Moment = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]
"""Simulated time, in s."""
LAST_TICK = 10**15
"""Maximum tick. Ticks are 64-bit words; this many of the shortest ones last 300 years."""
Tick = Annotated[int, Field(ge=0, le=LAST_TICK)]


LIVE: JsonDict = {"live": True}
Live = Annotated[T, Field(json_schema_extra=LIVE)]
"""Field of params that an operator may set while the level runs: `gain: Live[Positive] = 2.0`."""


def to_tuple(value: Any) -> Any:
    """Convert one name or table, or a list of them, to a tuple. Return other values unchanged."""
    if isinstance(value, str | Mapping):
        return (value,)
    return tuple(value) if isinstance(value, list) else value


class Table(BaseModel):
    """Base class of every config table.

    Unknown keys are errors, values are frozen, and `true` is not accepted for 1. A text below a
    field is its description: see `describe_keys`.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    @model_validator(mode="before")
    @classmethod
    def _with_tuples(cls, table: Any) -> Any:
        """Convert TOML's lists to tuples, which are frozen."""
        if not isinstance(table, dict):
            return table
        # Dicts with keys that the user chooses are not changed.
        return {k: v if isinstance(v, dict) else freeze_lists(v) for k, v in table.items()}


def describe_keys(kind: type[BaseModel]) -> dict[str, FieldInfo]:
    """Return the fields of a table, each with its description, keyed by config key.

    The description of a field is the text below it, unless the field defines another one. pydantic
    can find such texts itself (`use_attribute_docstrings`), but would do so for every class when it
    is defined, which would delay each start of a rack by 0.2 s.
    """
    below = ChainMap(*(_find_field_texts(base) for base in kind.__mro__ if issubclass(base, Table)))
    for name, field in kind.model_fields.items():
        field.description = field.description or below.get(name)
    return {field.alias or name: field for name, field in kind.model_fields.items()}


@cache
def _find_field_texts(table: type[Table]) -> dict[str, str]:
    """Return the text below each field in the source of a table, keyed by field name."""
    texts = {}
    # A class typed at a prompt has no source.
    with suppress(OSError, TypeError):
        (declared,) = ast.parse(dedent(inspect.getsource(table))).body
        assert isinstance(declared, ast.ClassDef)
        for pair in pairwise(declared.body):
            match pair:
                case ast.AnnAssign(ast.Name(name)), ast.Expr(ast.Constant(str(text))):
                    texts[name] = " ".join(text.split())
    return texts


def freeze_lists(value: Any) -> Any:
    """Return a TOML value with all lists converted to tuples, including lists inside tables."""
    if isinstance(value, dict):
        return {key: freeze_lists(item) for key, item in value.items()}
    return tuple(map(freeze_lists, value)) if isinstance(value, list) else value


Params = TypeVar("Params", bound=Table)


def read_params(kind: type[Params], params: Mapping[str, Any]) -> Params:
    """Validate `params` and return them as a record of class `kind`.

    Raises:
        LevelError: A value is invalid. The text has the key, the value and the valid keys.
    """
    try:
        return kind(**params)
    except ValidationError as error:
        valid = ", ".join(kind.model_fields)
        raise LevelError(f"params.{describe_first_error(error)}; keys: {valid}") from error


def read_program(
    validate: Callable[[Mapping[str, Any]], T],
    table: Mapping[str, Any],
    find_mismatches: Callable[[T], Iterable[tuple[str, Any, str]]],
    place: str = "",
) -> T:
    """Return a valid program, or a part of one.

    Args:
        validate: Converts the table with pydantic.
        table: The program as a table.
        find_mismatches: Returns the inconsistencies of the program with arm or scene.
        place: Prefix of the keys in the error text.

    Raises:
        ProgramError: The program is invalid. The text has one line per mistake.
    """
    try:
        program = validate(table)
    except ValidationError as error:
        mistakes = [
            f"{place}{'.'.join(map(str, entry['loc']))}: {entry['msg']}" for entry in error.errors()
        ]
        raise ProgramError("\n".join(mistakes)) from error
    if mistakes := [
        f"{place}{key} = {value!r}: {why}" for key, value, why in find_mismatches(program)
    ]:
        raise ProgramError("\n".join(mistakes))
    return program


def describe_first_error(error: ValidationError) -> str:
    """Return the key, the value and the reason of the first mistake that pydantic has found."""
    first = error.errors()[0]
    return f"{'.'.join(map(str, first['loc']))} = {first['input']!r}: {first['msg'].lower()}"


def list_live_keys(kind: type[Table] | None) -> tuple[str, ...]:
    """Return the names of the params that may be set while the level runs."""
    fields = {} if kind is None else kind.model_fields
    return tuple(key for key, field in fields.items() if field.json_schema_extra == LIVE)


def read_setting(setting: str) -> tuple[str, Any]:
    """Parse a text "key=value", whose value is in TOML. Return the key and the value.

    Raises:
        LevelError: The text does not have this form.
    """
    key, _, text = setting.partition("=")
    try:
        return key.strip(), load_toml(f"value = {text}")["value"]
    # The errors of the TOML parser derive from `ValueError`.
    except ValueError:
        raise LevelError("must be key=value, as in bandwidth=80") from None


def set_live(params: Params, setting: str) -> tuple[Params, str]:
    """Set a live parameter by "key=value".

    Returns:
        The new params and an empty string or, if the parameter cannot be set, the unchanged params
        and the reason.
    """
    kind = type(params)
    try:
        key, value = read_setting(setting)
        if key not in (live := list_live_keys(kind)):
            return params, f"params.{key} is not live; live: {', '.join(live) or 'none'}"
        return read_params(kind, {**dict(params), key: value}), ""
    except LevelError as error:
        return params, str(error)


def validate_class(reference: str, base: type[T]) -> type[T]:
    """Return the subclass of `base` that a reference "package.module:Class" names.

    Raises:
        ValueError: The class is missing, abstract, or not a subclass of `base`.
    """
    try:
        return find_class(reference, base)
    except LookupError as error:
        raise ValueError(str(error)) from error


class SensorConfig(Table):
    """Resolution and noise of the joint encoders.

    One value for all joints, or a list with one per joint. 0 means exact. Velocities have ten times
    as much of both, in rad/s; see `rack.levels.robot.limits.Encoders`.
    """

    resolution: NotNegative | tuple[NotNegative, ...] = 0.0
    """step of a joint position as sensed [rad]"""
    noise: NotNegative | tuple[NotNegative, ...] = 0.0
    """standard deviation of a joint position as sensed [rad]"""


class CalibrationConfig(Table):
    """`[robot.calibration]`: how the drives' samples become positions of the joints."""

    offset: tuple[Finite, ...] | None = None
    """added to every position that the drives report [rad]; default: nothing"""
    homing: bool = False
    """whether the drives search for their reference while they are being enabled, and know no
    position before"""


GRIPPER_DAMPING_S = 0.03
"""Ratio of the default damping of a gripper's position loop to its stiffness, in s."""
STILL_DIVISOR = 20
"""Ratio of a gripper's travel to the largest motion that counts as rest.

The opening may be a length or an angle, so the threshold is relative.
"""


class FollowConfig(Table):
    """`[[robot.gripper.follow]]`: a joint that moves with the gripper's driven joint.

    For joints that the model does not couple. Their actuators are removed.
    """

    joint: str
    """MJCF joint that follows the driven one"""
    ratio: Finite = 1.0
    """motion of the joint per motion of the driven joint, from the model's reference pose"""


class GripperConfig(Table):
    """A gripper driven by one actuator along one joint."""

    actuator: str
    """MJCF actuator that drives the gripper"""
    joint: str
    """MJCF joint whose position is the opening"""
    open: Finite
    """joint position when open [m or rad]"""
    closed: Finite
    """joint position when closed without an object [m or rad]"""
    force: Positive
    """largest force or torque of the actuator [N or N m]"""
    stiffness: Positive | None = None
    """of the position loop [N/m or N m/rad]; default: full force at half of the travel"""
    damping: Positive | None = None
    """of the position loop [N s/m or N m s/rad]; default: 30 ms times the stiffness"""
    follow: tuple[FollowConfig, ...] = ()
    """joints that follow the driven joint although the model does not couple them"""
    residual: Positive = 0.012
    """largest distance by which fingers may settle from their planned pose because soft couplings
    yield, or by which a loop may stay open [m]; the default is less than the 15 mm clearance of
    planned motion"""

    @model_validator(mode="after")
    def _check_travel(self) -> GripperConfig:
        """Check that `open` and `closed` differ."""
        if self.open == self.closed:
            raise ValueError(f"open and closed are both {self.open:g}: the gripper does not move")
        return self

    @property
    def travel(self) -> float:
        """Distance of the driven joint from open to closed, in m or rad."""
        return abs(self.open - self.closed)

    @property
    def gains(self) -> tuple[float, float]:
        """Stiffness and damping of the position loop in N/m and N s/m, or N m/rad and N m s/rad."""
        stiffness = self.stiffness or 2.0 * self.force / self.travel
        return stiffness, self.damping or GRIPPER_DAMPING_S * stiffness

    @property
    def rest_threshold(self) -> float:
        """Largest motion of the driven joint that counts as rest, in m or rad.

        The largest speed that counts as rest is this distance per second.
        """
        return self.travel / STILL_DIVISOR


class WristConfig(Table):
    """`[robot.wrist]`: a force/torque sensor between arm and tool, and limits on contact."""

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
    """joints of the finger, a part of robot.joints, base to tip"""


class HandConfig(Table):
    """`[robot.hand]`: a hand whose joints are driven by pairs of tendons, which can only pull.

    Lists have one value per joint.
    """

    finger: tuple[FingerConfig, ...] = Field(min_length=1)
    """the fingers"""
    flexors: tuple[str, ...]
    """MJCF actuators on the tendons that turn a joint in positive direction"""
    extensors: tuple[str, ...]
    """MJCF actuators on the tendons that turn a joint in negative direction"""
    least: Positive
    """tension below which a tendon is slack [N]"""
    rest: Positive
    """mean tension of a pair at rest [N]; it stiffens the joints if `stiffening` is above 0"""
    closed: NotNegative = 0.0
    """stiffness of a slack tendon whose valve is closed, due to the enclosed air [N/m]; with 0 it
    keeps its tension"""
    stiffening: NotNegative = 0.0
    """fraction by which each newton of tension raises that stiffness [1/N]; above 0, the tendon is
    a spring while its valve is open, too, against its tension loop"""


class ToolConfig(Table):
    """`[robot.tool_offset]`: the tool's frame on a body, for a model without a site for it."""

    position: Vector = (0.0, 0.0, 0.0)
    """of the tool in the body's frame [m]"""
    quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
    """of the tool in the body's frame, as w, x, y, z; its z axis is the direction of approach"""


class RobotConfig(Table):
    """`[robot]`: an arm, given by its MJCF file and data that the file lacks.

    Lists have one value per joint.
    """

    model: Path = Field(strict=False)
    """MJCF file of the arm and its cell; relative to the config"""
    joints: tuple[str, ...] = Field((), min_length=1, max_length=MAX_JOINTS)
    """MJCF joints of the arm, base to tool; default: those with an actuator, without the
    gripper's"""
    tool: str = Field("", min_length=1)
    """MJCF site whose pose is the tool's, or a body; default: the last site that the arm carries,
    else its last body"""
    tool_offset: ToolConfig | None = None
    """pose of the tool on the body that `tool` names; default: the body's own"""
    home: tuple[Finite, ...] = Field((), min_length=1)
    """joint positions to which tasks return, and the simulated start [rad]; default: the
    first keyframe"""
    start: tuple[Finite, ...] | None = None
    """start position of the simulated arm [rad]; default: home"""
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
    """command that the drives accept in every cycle: torques, or set points of position or velocity
    for drives that close their control loops themselves, which the simulated arm does, too"""
    exclude: tuple[tuple[str, str], ...] = ()
    """pairs of MJCF bodies whose contacts are ignored, in addition to the model's exclusions"""
    gripper: GripperConfig | None = None
    """gripper, if the arm has one"""
    sensors: SensorConfig | None = None
    """resolution and noise of the joints' encoders; default: exact if they are simulated, 1e-4 and
    5e-5 rad otherwise, see `rack.levels.arm.Arm.sensors`"""
    calibration: CalibrationConfig = CalibrationConfig()
    """conversion of the drives' samples to joint positions"""
    latency_ticks: int = Field(0, ge=0, le=20)
    """age of the newest sample when a cycle reads it, due to the bus to the drives [ticks]; the
    simulated arm delays its samples accordingly"""
    wrist: WristConfig | None = None
    """force/torque sensor, if the arm has one"""
    hand: HandConfig | None = None
    """tendons and fingers, for a hand in place of an arm"""
    patience_ms: Positive | None = Field(None, le=100.0)
    """time for which motors keep the last torque when no new one arrives [ms]; then the brakes
    engage; rounded down to whole torque cycles, at least one; the default depends on the arm's
    motion in that time, see `rack check --verbose`"""
    substeps: int = Field(5, ge=1, le=50)
    """MuJoCo steps in one servo cycle"""
    min_armature: Finite = Field(0.05, ge=0)
    """minimum drive inertia of every joint [kg m2]; light wrists need it"""
    enable: Literal["at-start", "by-command"] | None = None
    """when drives are enabled: at the start, or by `rack command RACK servo enable`;
    default: at-start for the simulated arm, by-command for every other"""
    bring_up: Positive | None = Field(None, le=1.0)
    """fraction of full speed at which the arm moves until `rack command RACK servo release`;
    default: full speed from the start"""
    guessed: tuple[str, ...] = ()
    """keys of this table whose values were guessed, such as gripper.force; an arm that is not
    simulated is not enabled until each is confirmed by removing it here"""

    def find_length_mismatches(self) -> Iterator[tuple[str, Any, str]]:
        """Yield key, values and reason for every list that does not have one value per joint."""
        joints = len(self.joints)
        keys = ("home", "start", "velocity", "acceleration", "jerk", "torque", "position")
        lists = {key: getattr(self, key) for key in keys}
        lists["calibration.offset"] = self.calibration.offset
        for key, values in lists.items():
            if values is not None and len(values) != joints:
                yield key, values, f"has {len(values)} values but needs {joints}, one per joint"
        for key, values in self.sensors or ():
            if isinstance(values, tuple) and len(values) != joints:
                why = f"has {len(values)} values but needs one for all joints, or one per joint"
                yield f"sensors.{key}", values, f"{why}: {joints}"

    @field_validator("guessed")
    @classmethod
    def _check_guessed(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        """Check that every name begins with a key of this table."""
        for name in names:
            if name.partition(".")[0] not in cls.model_fields:
                raise ValueError(
                    f"'{name}' is not a key of [robot]; `rack schema robot` lists them"
                )
        return names

    @property
    def tool_name(self) -> str:
        """Name of the site at the tool. With `tool_offset`, a site of this name is added."""
        return self.tool if self.tool_offset is None else f"tool of {self.tool}"


class MotionConfig(Table):
    """A move of an obstacle, a mocap body, in the simulated cell at a fixed time."""

    body: str
    """obstacle that moves"""
    at: Moment
    """simulated time when it starts [s]"""
    to: Vector
    """final position of its origin [m]"""
    speed: Positive = 0.25
    """speed along the straight line [m/s]"""


class PushConfig(Table):
    """`[[scene.push]]`: a force on an object in the simulated cell at a fixed time."""

    body: str
    """object that is pushed"""
    at: Moment
    """simulated time when it begins [s]"""
    seconds: Positive
    """time for which it lasts [s]"""
    force: Vector
    """force at the centre of mass, in the world's frame [N]"""
    rise: NotNegative = 0.0
    """time in which the force rises at the start and falls at the end [s]"""


class GoalConfig(Table):
    """`[[scene.goal]]`: where the task takes an object.

    Not needed for a task of transfers, which has its goals in the program.
    """

    object: str
    """object that the task moves, or leaves in place"""
    position: Vector
    """final position of its origin [m]"""
    # A gripper centres a part across its pads, but not along them. In that direction the part keeps
    # its offset, or slips.
    tolerance_mm: Positive = 10.0
    """distance from the goal within which the task counts as done [mm]"""


class SceneConfig(Table):
    """`[scene]`: objects and obstacles in the cell, by their names in the MJCF file."""

    objects: tuple[str, ...] = ()
    """free bodies that tasks may move"""
    obstacles: tuple[str, ...] = ()
    """mocap bodies that may move by themselves"""
    supports: tuple[str, ...] = ()
    """geoms on which objects may stand, and on which a tool on a wrist sensor may press"""
    clearance: Positive = 0.015
    """distance that planned motion keeps from everything [m]"""
    motion: tuple[MotionConfig, ...] = ()
    """moves of obstacles, by time"""
    push: tuple[PushConfig, ...] = ()
    """forces on objects, by time"""
    goal: tuple[GoalConfig, ...] = ()
    """where objects are when the task is done"""

    @property
    def bodies(self) -> tuple[str, ...]:
        """Objects, then obstacles, in the order of the rows of the world model."""
        return self.objects + self.obstacles
