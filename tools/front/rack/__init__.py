"""The package of nasrem-rack: a rack from a Python program or a notebook.

    import rack

    with rack.Rack.from_file("nasrem") as nasrem, rack.attach("nasrem") as live:
        nasrem.run_in_background()
        live.wait_until("servo.status.position[2] > -2.5", timeout_s=30)
        print(live["servo.status.torque"])
    run = rack.open_run("runs/nasrem-20250101-120000")
    run.signals["servo.status.position"].to_pandas()

- `Rack` launches the boards of a config; `attach` reads and commands a rack that is running, of any
  program; `open_run` reads what `rack run` or `rack record` left.
- `Failure` is what goes wrong with either of the two; its text is that of the command.

Names are imported on first use: to import `rack` costs nothing.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

# In a checkout this file and the floors are links in .venv: their files are where these lead.
__path__ = [
    str(Path(__file__).with_name("backplane").resolve().parent),
    str(Path(__file__).resolve().parent),
]

from rack.backplane.exports import on_first_use

if TYPE_CHECKING:
    from rack.boards.crate.rack import Rack
    from rack.tools.console.answer import Failure
    from rack.tools.scripting.attached import attach
    from rack.tools.scripting.recorded import open_run

__all__ = ["Failure", "Rack", "attach", "open_run"]
_PLACES = {
    "rack.boards.crate.rack": ("Rack",),
    "rack.tools.console.answer": ("Failure",),
    "rack.tools.scripting.attached": ("attach",),
    "rack.tools.scripting.recorded": ("open_run",),
}

if not TYPE_CHECKING:  # a type checker would take every misspelt name for one of these
    __getattr__ = on_first_use(__name__, _PLACES)
