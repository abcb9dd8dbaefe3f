"""What a trial is to do: its faults as `[[fault]]` tables, and the kills that come from outside."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Literal

from rack.boards.config.schema import RackConfig
from rack.boards.config.toml import to_toml
from rack.boards.faults.config import FaultConfig

EXTERNAL = "external kill"
"""The kind, in reports, of a SIGKILL that the campaign itself sends: no fault tool has a part in it."""

Purpose = Literal["faults", "kills", "sizes", "nominal", "faultless"]


@dataclass(frozen=True)
class Kill:
    """One SIGKILL from outside: which process, and when. `phase` is the part of the tick that has passed."""

    board: str
    tick: int
    phase: float


@dataclass(frozen=True)
class Plan:
    """One trial. `faults` are tables as in a config; a plan repeats by `rack run CONFIG --faults FILE`."""

    number: int
    purpose: Purpose
    lockstep: bool
    faults: tuple[Mapping[str, Any], ...] = ()
    kills: tuple[Kill, ...] = ()

    def config(self, config: RackConfig, rack: str) -> RackConfig:
        """Return the config that runs this plan, under a name of its own."""
        # A speed is of real time alone.
        clock = {"mode": "lockstep", "speed": 1.0} if self.lockstep else {"mode": "realtime"}
        faults = tuple(FaultConfig.model_validate(table) for table in self.faults)
        return config.model_copy(
            update={"name": rack, "clock": config.clock.model_copy(update=clock), "fault": config.fault + faults}
        )

    def document(self) -> dict[str, Any]:
        """Return the plan as plain data."""
        return asdict(self)

    def toml(self, config: str) -> str:
        """Return the faults as a file for `--faults`; kills from outside, which no file can hold, as comments."""
        mode = " --lockstep" if self.lockstep else ""
        lines = [f"# Trial {self.number}: rack run {config}{mode} --faults THIS_FILE"]
        lines += [f"# {EXTERNAL}: {kill.board} at tick {kill.tick} + {kill.phase:g}" for kill in self.kills]
        return "\n".join([*lines, "", to_toml({"fault": [dict(table) for table in self.faults]})])
