"""Names of earlier versions in configs."""

from __future__ import annotations

import pytest

from rack.boards import Rack
from rack.boards.config import CONFIGS, load, loads, wire
from rack.boards.config.schema import RackConfig
from rack.levels.references import MOVED, current, module_and_name

SYSTEMS = ("fig2", "nist-state-table", "rccl", "hic", "penn", "chimera", "cell/puma", "cell")


def as_saved_before(config: RackConfig) -> tuple[RackConfig, list[str]]:
    """Return a config as a run of an earlier version saved it, and the old names in it."""
    text, used = config.text(), []
    for old, new in MOVED.items():
        if (changed := text.replace(f'"{new}:', f'"{old}:') if ":" not in old else text.replace(new, old)) != text:
            text, used = changed, [*used, old]
    return loads(text), used


def test_each_old_name_leads_to_what_is_there() -> None:
    for old in MOVED:
        module, name = module_and_name(old if ":" in old else f"{old}:")
        assert not name or hasattr(module, name), old


def test_names_that_only_begin_like_a_moved_one_stay() -> None:
    assert current("rack.levels.handle:Grip") == "rack.levels.handle:Grip"
    assert current("rack.levels.servo:ServoExecutor") == "rack.levels.servo:ServoExecutor"
    assert current("rack.levels.hand.workstation:Workstation") == "rack.levels.systems.hand.workstation:Workstation"


@pytest.mark.slow
@pytest.mark.parametrize("name", SYSTEMS)
def test_a_config_saved_before_is_wired_as_today(name: str) -> None:
    config = load(CONFIGS / f"{name}.toml" if "/" in name else name)
    saved, used = as_saved_before(config)
    assert used
    assert wire(saved) == wire(config)


@pytest.mark.slow
def test_a_config_saved_before_runs_as_today(rack_name: str) -> None:
    config = load("rccl", [f"name={rack_name}", "clock.mode=lockstep"])
    saved, used = as_saved_before(config)
    assert {"rack.levels.servo:JointServo", "rack.levels.trajectory"} <= set(used)
    digests = []
    for each in (config, saved):
        with Rack(each) as rack:
            digests.append(rack.run(0.2).digest)
    assert digests[0] == digests[1]
