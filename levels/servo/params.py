"""What a config may set of the servo level, in `[board.<name>.params]`."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from rack.levels.robot import Positive, Table

Reacting = Literal["hold", "stop", "brake"]


class ServoParams(Table):
    """Gains of the joint loop, and what it does about faults of sensors and motors."""

    bandwidth: Positive = Field(60.0, le=400.0, description="natural frequency of the error in every joint, rad/s")
    damping: Positive = Field(1.0, le=3.0, description="damping ratio of the error")
    following: Positive = Field(
        0.02, description="distance of a joint from its set point that no sound motor leaves, rad"
    )
    on_sensor_fault: Reacting = Field(
        "brake", description="ramp to rest and hold, or ramp and brake, or brake; without known velocities always brake"
    )
    on_actuator_fault: Reacting = Field("brake", description="ramp to rest and hold, or ramp and brake, or brake")
    good_cycles: int = Field(20, ge=1, le=10_000, description="good cycles in a row after which a fault is over")
    retry: Positive = Field(
        0.5, description="time after which a motor that gave too little is tried again, or a struck arm goes on, s"
    )
    patience: Positive = Field(
        5.0, description="time for which faults may keep the arm from its set points; then they are latched, s"
    )
