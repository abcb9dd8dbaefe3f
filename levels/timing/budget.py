"""What the parts of one level's cycle may take: the numbers that the timing model starts from."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Budget:
    """Worst-case processor times of one level, ns. 0: nothing of that kind.

    `read_ns` (R), `process_ns` (X, t_exec) and `write_ns` (W) are of the executor's cycle, and so is `exchange_ns`
    (C): reading the plan. `plan_ns` (P) and `update_ns` (U) are of one plan. The paper's t_plan is the sum of both.
    """

    read_ns: int = 0
    process_ns: int = 0
    write_ns: int = 0
    exchange_ns: int = 0
    plan_ns: int = 0
    update_ns: int = 0

    @property
    def interlevel_ns(self) -> int:
        """t_interlevel of eq. 3.9: what a cycle spends on commands and statuses."""
        return self.read_ns + self.write_ns
