"""What became of a command that was handed over: when it was given, and what its level says to it."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any, Literal

Fate = Literal["given", "taken", "done", "refused", "overtaken"]


@dataclass(frozen=True)
class Told:
    """One command. `taken_up` and `done` are releases of the level, in ticks; -1: not, or not yet.

    Its fate is "given" where the level's status does not answer operators. `objection` is of a refusal.
    """

    serial: int
    level: str
    text: str
    given: int
    fate: Fate = "given"
    taken_up: int = -1
    done: int = -1
    objection: str = ""

    @property
    def worked(self) -> bool:
        """Whether it was not refused."""
        return self.fate != "refused"

    @property
    def is_standing(self) -> bool:
        """Whether its level has it in force, as far as is known."""
        return self.fate in ("taken", "done")

    def document(self) -> dict[str, Any]:
        """Return everything as plain data."""
        return {**asdict(self), "worked": self.worked}

    @property
    def line(self) -> str:
        """All of it for people."""
        ends = {
            "given": "; the status of this level does not answer operators",
            "taken": f", taken up at tick {self.taken_up}",
            "done": f", taken up at tick {self.taken_up}, done at tick {self.done}",
            "refused": f", refused at tick {self.taken_up}: {self.objection}",
            "overtaken": ", overtaken by a newer command",
        }
        return f"command {self.serial} to '{self.level}', {self.text}: given at tick {self.given}{ends[self.fate]}"
