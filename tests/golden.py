"""The digests of the shipped racks, which every machine must come to, in golden.toml.

    make golden         runs each of RUNS in lockstep and writes the file anew

That is due whenever a change alters what a rack does, and after `make lock`. The file names what
else the bits depend on: the libraries, and the C library's `sin`, `exp` and the like, which the
lock file does not pin.
"""

from __future__ import annotations

import json
import shlex
import sys
import tomllib
from importlib.metadata import version
from pathlib import Path

from rack.boards import Rack
from rack.boards.config import load
from rack.boards.crate.line import build_environment
from tests.processes import run_to_end

FILE = Path(__file__).with_suffix(".toml")
OFTEN = (
    "nasrem --seconds 14",
    "nist-state-table --seconds 5",
    "fig2 --seconds 1",
)
"""What `make test` runs, too; the others are for `make thorough`."""
RUNS = (
    *OFTEN,
    "nasrem --faults kill-each-board --seconds 9",
    "k1607",
    "brown/one-machine --seconds 4",
    "hic --seconds 2",
    "hic --seconds 6",
    "nasrem-1khz --seconds 8",
    "crossing --seconds 14",
    "rccl --seconds 4",
    "chimera",
    "penn --seconds 14",
    "ibm --seconds 14",
    "condor --seconds 4",
    "cyclic --seconds 8",
    "nasrem --faults bad-sensors --seconds 8",
    "nasrem --faults bad-motors --seconds 8",
    "nasrem --faults noisy-bus --seconds 9",
    "nasrem-three-poses --seconds 3",
    "fig3 --seconds 1",
    "fig4 --seconds 1",
    "fig4-overload --seconds 1",
    "nist-state-table/direct --seconds 3",
    "nist-state-table/three-poses --seconds 3",
    "rccl/three-poses --seconds 3",
    "brown/three-poses --seconds 3",
    "chimera/three-poses --seconds 3",
    "penn/three-poses --seconds 3",
    "ibm/three-poses --seconds 3",
    "penn --faults client-dies --seconds 11",
    *(
        f"{system} --faults kill-each-board --seconds 5"
        for system in ("brown/one-machine", "rccl", "nist-state-table", "hic", "penn")
    ),
    *(f"{system} --faults kill-each-board --seconds 5" for system in ("ibm", "chimera", "condor")),
    "configs/examples/own-level/metered.toml --seconds 2",
    "configs/examples/own-servo/pd.toml --seconds 2",
    "configs/examples/own-modification/gentle.toml --seconds 2",
    "configs/examples/own-planner/trapezoid.toml --seconds 4",
    "configs/examples/own-hardware/hardware.toml --seconds 2 --set robot.enable=at-start",
    "configs/examples/own-arm/desk-arm.toml --seconds 2",
)
"""As one would call `rack run`, but for --lockstep. The script `overload` needs real time."""
HOSTED = ("chimera", "condor", "ibm", "penn")
"""Racks with programs on the host side, whose state cannot be copied: these are repeated with the
messages that the programs sent."""
CONTINUED = tuple({run.split()[0]: run for run in RUNS if not run.startswith(HOSTED)}.values())
"""The last run of each other rack: snapshots of it are continued to the same digest, too."""
LIBRARIES = ("daqp", "mujoco", "numpy", "ompl", "ruckig")
PROBE = """
import hashlib, math
of = (math.sin, math.cos, math.tan, math.exp, math.atan, math.tanh, math.asinh)
of += (math.sinh, math.cbrt, math.log1p)
values = [f(0.01 * k) for f in of for k in range(1, 1000)]
values += [f(0.001 * k) for f in (math.asin, math.acos, math.log) for k in range(1, 1000)]
values += [math.atan2(0.01 * k, 1.0) + (0.01 * k) ** 3.0 for k in range(1, 1000)]
print(hashlib.sha256(repr(values).encode()).hexdigest()[:16])
"""


def digest(run: str, name: str) -> str:
    """Return the digest of one of `RUNS`, run as the rack `name`."""
    words = shlex.split(run)
    options = dict(zip(words[1::2], words[2::2], strict=True))
    place = FILE.parents[1] / words[0]
    config = load(
        place if place.is_file() else words[0],
        [f"name={name}", "clock.mode=lockstep", *options.get("--set", "").split()],
        options.get("--faults"),
    )
    with Rack(config) as rack:
        seconds = options.get("--seconds")
        return rack.run(None if seconds is None else float(seconds)).digest


def machine() -> dict[str, str]:
    """Return what the bits depend on, in the environment of the boards."""
    libm = run_to_end([sys.executable, "-c", PROBE], 60, env=build_environment(), check=True)
    return {**{library: version(library) for library in LIBRARIES}, "libm": libm.stdout.strip()}


def read() -> dict[str, dict[str, str]]:
    """Return the file: `digests` by run, and the `machine` that they were made on."""
    return tomllib.loads(FILE.read_text())


def main() -> None:
    """Write the file anew."""
    tables = {"machine": machine(), "digests": {run: digest(run, "golden") for run in RUNS}}
    lines = ["# Made by `make golden`, see golden.py; no line is meant to be written by hand."]
    for name, table in tables.items():
        # A JSON string is a TOML string.
        lines += [
            "",
            f"[{name}]",
            *(f"{json.dumps(key)} = {json.dumps(value)}" for key, value in table.items()),
        ]
    FILE.write_text("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
