"""The `[robot]` table: an arm is data, an MJCF file and what its model does not say."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, model_validator

# No quantity of an arm in SI units, nor of its time, is beyond these: sums and squares of them stay finite.
# pydantic keeps one bound of a kind: fields that are narrower say so with `le` and `ge`.
Positive = Annotated[float, Field(gt=0, lt=1e9, allow_inf_nan=False)]
Finite = Annotated[float, Field(gt=-1e9, lt=1e9, allow_inf_nan=False)]
LAST_TICK = 10**15
"""Ticks are 64-bit words: this many of the shortest are 300 years."""


class Table(BaseModel):
    """Base of every config table: unknown keys are errors, values do not change, nor does `true` pass for 1."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    @model_validator(mode="before")
    @classmethod
    def _with_tuples(cls, table: Any) -> Any:
        """TOML has lists for what does not change here."""
        return {key: _tuple(value) for key, value in table.items()} if isinstance(table, dict) else table


def _tuple(value: Any) -> Any:
    return tuple(_tuple(item) for item in value) if isinstance(value, list) else value


NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class SensorConfig(Table):
    """What the joints' encoders resolve: one value for all joints, or a list with one a joint; 0: exact.

    Drives time the encoder's edges for velocities: these have a tenth of a second's worth of both, see `Encoders`.
    """

    resolution: NotNegative | tuple[NotNegative, ...] = Field(
        0.0, description="step of a joint position as sensed, rad"
    )
    noise: NotNegative | tuple[NotNegative, ...] = Field(
        0.0, description="standard deviation of a joint position as sensed, rad"
    )


class GripperConfig(Table):
    """A gripper driven by one actuator along one joint."""

    actuator: str = Field(description="MJCF actuator that drives the gripper")
    joint: str = Field(description="MJCF joint whose position is the opening")
    open: Finite = Field(description="joint position when open, m or rad")
    closed: Finite = Field(description="joint position when closed on nothing, m or rad")
    force: Positive = Field(description="largest force or torque of the actuator, N or N m")
    stiffness: Positive = Field(2000.0, description="position loop, N/m")
    damping: Positive = Field(60.0, description="position loop, N s/m")


class RobotConfig(Table):
    """An arm: its MJCF file and what the model does not say. Lists have one value a joint."""

    model: Path = Field(strict=False, description="MJCF file of the arm and its cell; relative to the config")
    joints: tuple[str, ...] = Field(min_length=1, max_length=16, description="MJCF joints of the arm, base to tool")
    tool: str = Field(description="MJCF site whose pose is the tool's; for a model without one, its last body")
    home: tuple[Finite, ...] = Field(description="joint positions at the start, rad")
    velocity: tuple[Positive, ...] = Field(description="velocity limits, rad/s")
    acceleration: tuple[Positive, ...] = Field(description="acceleration limits of planned motion, rad/s2")
    jerk: tuple[Positive, ...] = Field(description="jerk limits of planned motion, rad/s3")
    torque: tuple[Positive, ...] | None = Field(
        None, description="torque limits, N m; without it the model's actuator limits hold"
    )
    position: tuple[tuple[Finite, Finite], ...] | None = Field(
        None, description="position limits, rad; without it the model's joint ranges hold"
    )
    gripper: GripperConfig | None = Field(None, description="gripper, if the arm has one")
    sensors: SensorConfig = Field(SensorConfig(), description="resolution and noise of the joints' encoders")
    substeps: int = Field(5, ge=1, le=50, description="MuJoCo steps in one servo cycle")
    min_armature: Finite = Field(
        0.05, ge=0, description="drive inertia that every joint has at least, kg m2: light wrists need it"
    )
