"""What had the core while a cycle lasted: itself, others of the rack, or nobody of the rack: then the machine."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from rack.tools.analysis.cycles import Cycles, occupation
from rack.tools.analysis.occupation import Occupation

TOLD = 0.1
"""Part of that time from which on what filled it is told."""
BEFORE = "the cycle before"
UNUSUAL = 1.5
"""Times its usual own time, from which on a cycle is told to have computed long."""


@dataclass(frozen=True)
class Company:
    """How the time was filled in which a cycle was due, until its end, ns.

    `own_ns` is the cycle's own processor time and `usual_ns` what that is in the middle of all cycles: a virtual
    machine that its host stalls counts as own time, too. `others_ns` are the tasks of the rack that kept it from the
    core, and `nobody_ns` what no trace accounts for: the clock's and the kernel's own work, or other programs.
    """

    lasted_ns: int
    own_ns: int
    usual_ns: int
    others_ns: Mapping[str, int]
    nobody_ns: int

    def text(self) -> str:
        """Return what filled the cycle, the most first."""
        told = sorted(self._told(), reverse=True)
        return "; ".join(text for _, text in told) or f"computed {_ms(self.own_ns)}, as usual"

    def _told(self) -> Iterator[tuple[int, str]]:
        least = TOLD * self.lasted_ns
        if self.own_ns > UNUSUAL * self.usual_ns:
            yield self.own_ns, f"computed {_ms(self.own_ns)}, usually {_ms(self.usual_ns)}"
        for name, ns in self.others_ns.items():
            if ns > least:
                yield (
                    ns,
                    f"the cycle before lasted {_ms(ns)} of it"
                    if name == BEFORE
                    else f"{name} had the core for {_ms(ns)}",
                )
        if self.nobody_ns > least:
            yield self.nobody_ns, f"nobody of the rack for {_ms(self.nobody_ns)}"


def companies(
    name: str, at: np.ndarray, due_ns: np.ndarray, found: Mapping[str, Cycles], critical: Collection[str] = ()
) -> list[Company]:
    """Return the company of the cycles of a task at the places `at`, of all that `cycles_of` found.

    `due_ns` is since when each was due: since the releases that it skipped, if any. Both have shape (n,). `critical`
    are the boards whose plan update is a critical section: it keeps the executor waiting.
    """
    cycles = found[name]
    rows = cycles.rows[at]
    starts, ends = due_ns, rows["end_ns"]
    rivals = {other: occupation(rival.rows) for other, rival in found.items() if _may_keep_away(cycles, rival)}
    if cycles.task.board in critical and (planner := found.get(f"{name}.planner")) is not None:
        rivals[planner.task.name] = Occupation(planner.rows["process_ns"], planner.rows["end_ns"])
    kept = {other: occupied.within(starts, ends) for other, occupied in rivals.items()}
    together = Occupation.of_all(list(rivals.values())).within(starts, ends)
    # A release may come while the cycle before it still lasts.
    begins = np.maximum(starts, rows["start_ns"] - cycles.overhead_ns)
    kept[BEFORE] = before = occupation(cycles.rows).within(starts, begins)
    lasted, own = ends - starts, cycles.used_ns[at]
    # Ordinary scheduling shares a core among all that want it: no more than the rest was another's.
    left = np.clip(lasted - own, 0, None)
    nobody = np.clip(left - together - before, 0, None)
    usual = int(np.median(cycles.used_ns))
    return [
        Company(
            lasted_ns=int(lasted[row]),
            own_ns=int(own[row]),
            usual_ns=usual,
            others_ns={other: int(min(ns[row], left[row])) for other, ns in kept.items() if ns[row]},
            nobody_ns=int(nobody[row]),
        )
        for row in range(len(at))
    ]


def _may_keep_away(cycles: Cycles, rival: Cycles) -> bool:
    """Say whether a task can have had the core while another wanted it, by their priorities."""
    is_another = rival.task.name != cycles.task.name
    return is_another and rival.core == cycles.core and rival.priority >= cycles.priority


def _ms(ns: float) -> str:
    return f"{ns * 1e-6:.3g} ms"
