"""The `[scene]` table: what stands in the cell besides the arm, by its names in the MJCF."""

from __future__ import annotations

from pydantic import Field

from rack.levels.robot import Finite, Positive, Table


class MotionConfig(Table):
    """A move of an obstacle, done by the simulated cell at a fixed time: a mocap body goes to a place."""

    body: str = Field(description="obstacle that moves")
    at: float = Field(ge=0, le=1e9, allow_inf_nan=False, description="simulated time when it starts, s")
    to: tuple[Finite, Finite, Finite] = Field(description="where its origin goes, m")
    speed: Positive = Field(0.25, description="speed along the straight line, m/s")


class SceneConfig(Table):
    """Bodies of the cell that the world model follows."""

    objects: tuple[str, ...] = Field((), description="free bodies that tasks may move")
    obstacles: tuple[str, ...] = Field((), description="mocap bodies that may move by themselves")
    supports: tuple[str, ...] = Field((), description="geoms on which objects may stand")
    clearance: Positive = Field(0.015, description="distance that planned motion keeps from everything, m")
    motion: tuple[MotionConfig, ...] = Field((), description="moves of obstacles, by time")

    @property
    def bodies(self) -> tuple[str, ...]:
        """Objects, then obstacles: the order of the world model's rows."""
        return self.objects + self.obstacles
