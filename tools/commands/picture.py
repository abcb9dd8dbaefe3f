"""`rack picture`: draw the first view of a run, or its cell, without a screen."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from rack.tools.commands.replay import find_viewer_files, merge_runs
from rack.tools.commands.watch import check_writable
from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, RunFolder, option
from rack.tools.console.progress import announce_waiting
from rack.tools.launch.continued import parse_tick
from rack.tools.recording.recording import Recording
from rack.tools.viewer.parts import FILE


def picture(
    run: RunFolder,
    at: float = option("--at S", "simulated time to look at, s", ...),
    out: Path | None = option(
        "--out FILE.png", "file to write; default: picture-<S>s.png in the folder of the run"
    ),
    view: str | None = option(
        "--view NAME", "draw only the view with this title, or a part of it, as in boards"
    ),
    cell: bool = option(
        "--cell", "draw the cell alone, with MuJoCo, if the viewer cannot run", False
    ),
    as_json: Json = False,
) -> None:
    """Draw the first view of a run at a time, as 'rack replay' shows it, without a screen.

    A run without run.rrd is converted first. A machine without a graphics card needs a software
    driver; if packages are missing, the command names them.

    Exit status: 0 drawn; 1 drawn, but the viewer reported problems, or not drawn; 2 usage.

    \b
    Examples:
      rack picture runs/nasrem-20250101-120000 --at 11
      rack picture runs/nasrem-20250101-120000 --at 11 --view boards --out boards.png
      rack picture runs/nasrem-20250101-120000 --at 11 --cell
    """
    if cell and view is not None:
        raise Failure("--cell, --view: give one of them", 2)
    recording = Recording(run)
    tick = parse_tick(recording, str(at), "--at ")
    path = out or run / f"picture-{at:g}s.png"
    if path.suffix != ".png":
        raise Failure(f"--out {path}: the name of a picture must end in .png", 2)
    check_writable(path)
    with announce_waiting("drawing; without a graphics card this may take a minute", as_json):
        notes: list[str] = []
        if cell:
            _draw_cell(recording, tick, path)
        else:
            # Import late, because this takes half a second.
            from rack.tools.viewer.pictures import draw_picture

            with INTERRUPT.raise_interrupted(), ExitStack() as stack:
                files = find_viewer_files(run)
                if not files:
                    folder = stack.enter_context(TemporaryDirectory(prefix="rack-picture-"))
                    files = [Path(folder, FILE)]
                    merge_runs([run], files[0])
                drawn = draw_picture(files, at, view)
            path.write_bytes(drawn.png)
            notes = drawn.complaints
    document = {"picture": str(path), "at_s": at, "view": view, "notes": notes}
    print_answer(document, "\n".join([f"picture: {path}", *notes]), as_json)
    if notes:
        raise SystemExit(1)


def _draw_cell(recording: Recording, tick: int, path: Path) -> None:
    """Draw the cell of a run with MuJoCo. Raises `Failure`."""
    boxes = [box.name for box in recording.layout.mailboxes if box.message == "arm_state"]
    robot = recording.rack_config.robot
    ticks = recording.read_signal(boxes[0], "tick") if boxes else ()
    row = int(np.searchsorted(ticks, tick, "right")) - 1
    if robot is None or row < 0:
        raise Failure(f"--cell: rack '{recording.layout.rack}' has recorded no arm until then", 2)
    import mujoco

    from rack.levels.robot.cell import build_cell
    from rack.levels.robot.engine import view_state
    from rack.tools.robot.picture import NO_PICTURE, draw_arm

    cell = build_cell(robot, recording.rack_config.scene, recording.layout.clock_ns)
    data = cell.build_start_data()
    view_state(cell.model, data, recording.read_signal(boxes[0], "state")[row])
    mujoco.mj_forward(cell.model, data)
    if draw_arm(cell, path, data) == NO_PICTURE:
        raise Failure(NO_PICTURE)
