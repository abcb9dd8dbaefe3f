"""Racks that violate claims of the paper, run by the experiments of `rack reproduce`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from rack.boards.config.schema import RackConfig
from rack.tools.lab.benches.observed import ObservedRun
from rack.tools.lab.reproduction.experiments.experiment import Workshop

CHAIN = "chain"
"""Key of the rack of empty boards, which has no name."""


class BreakingWorkshop(Workshop):
    """Workshop that runs changed racks, each for at most `most_s` if that is given.

    `changes` are TOML texts by the name of the rack. `scripts` are TOML texts that replace fault
    scripts by name.
    """

    def __init__(
        self,
        folder: Path,
        changes: Mapping[str, str],
        most_s: float | None,
        scripts: Mapping[str, str] | None = None,
    ) -> None:
        super().__init__(folder, share=True)
        self._changes = changes
        self._most_s = most_s
        self._scripts = scripts or {}
        self.about = f"{changes}, {most_s} s, {self._scripts}"
        self.prepare()

    def find_source(self, name: str) -> str:
        """Return the path of a changed config, or the changed text of a chain.

        Changes that a chain cannot take are left out: a second protocol. An overrun changes only
        the chains in real time, where its cycles are counted.
        """
        if "\n" in name:
            changes = self._changes.get(CHAIN, "")
            clashes = (("[protocol]", "[protocol]"), ('"lockstep"', "overrun"))
            fits = not any(own in name and other in changes for own, other in clashes)
            return name + changes * fits
        changes = self._changes.get(name)
        if changes is None:
            return name
        base = "" if changes.startswith("name") else f'extends = ["{name}"]\n'
        return self._written(name, f"format = 2\n{base}{changes}")

    def load_config(
        self, name: str, settings: Sequence[str] = (), faults: str | None = None
    ) -> RackConfig:
        """Load a changed config with the changed script of this name."""
        if faults in self._scripts:
            faults = self._written(f"script-{faults}", self._scripts[faults])
        return super().load_config(name, settings, faults)

    def run(self, label: str, config: RackConfig, seconds: float | None = None) -> ObservedRun:
        """Run a rack for no longer than permitted."""
        limits = [limit for limit in (seconds, self._most_s) if limit is not None]
        return super().run(label, config, min(limits, default=None))

    def _written(self, name: str, text: str) -> str:
        path = self.folder / f"broken-{name.replace('/', '-')}.toml"
        path.write_text(text, encoding="utf-8")
        return str(path)
