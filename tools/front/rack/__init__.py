"""The package of nasrem-rack: a rack from a Python program or a notebook.

    import rack

    with rack.Rack("nasrem", lockstep=True, out="run") as nasrem, rack.attach("nasrem") as live:
        nasrem.run_in_background(seconds=10)
        live.wait_until("servo.status.position[2] > -2.5", timeout_s=30)
        print(live["servo.status.torque"])
        nasrem.wait()
    run = rack.open_run("run")
    run.signals["servo.status.position"].plot()

- `Rack` launches the boards of a config, and can record them. `attach` reads and commands a running
  rack, whichever program launched it. `open_run` reads a folder of `rack run` or `rack record`.
- `Failure` is raised when any of them fails, with the same text as the command. Its subclass
  `ConfigError` lists the mistakes of a config.

Names are imported on first use, so that importing `rack` costs nothing.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

# In a checkout this file and the packages are links in .venv, so resolve them.
__path__ = [
    str(Path(__file__).with_name("backplane").resolve().parent),
    str(Path(__file__).resolve().parent),
]

from rack.backplane.exports import build_lazy_getattr

if TYPE_CHECKING:
    from rack.boards.errors import ConfigError, Failure
    from rack.tools.scripting.attached import attach
    from rack.tools.scripting.launched import Rack
    from rack.tools.scripting.recorded import open_run

__all__ = ["ConfigError", "Failure", "Rack", "attach", "open_run"]
_PLACES = {
    "rack.boards.errors": ("ConfigError", "Failure"),
    "rack.tools.scripting.attached": ("attach",),
    "rack.tools.scripting.launched": ("Rack",),
    "rack.tools.scripting.recorded": ("open_run",),
}

# Hidden from type checkers, which would otherwise accept every misspelt name.
if not TYPE_CHECKING:
    __getattr__ = build_lazy_getattr(__name__, _PLACES)


def __dir__() -> list[str]:
    return __all__
