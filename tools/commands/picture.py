"""`rack picture`: draw the first view of a run, or one of its views, without a screen."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

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
        "--view NAME", "draw only the view with this title, or a part of it, as in cell"
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
      rack picture runs/nasrem-20250101-120000 --at 11 --view cell
    """
    parse_tick(Recording(run), str(at), "--at ")
    path = out or run / f"picture-{at:g}s.png"
    if path.suffix != ".png":
        raise Failure(f"--out {path}: the name of a picture must end in .png", 2)
    check_writable(path)
    with announce_waiting("drawing; without a graphics card this may take a minute", as_json):
        # Import late, because this takes half a second.
        from rack.tools.viewer.pictures import draw_picture

        with INTERRUPT.raise_interrupted(), TemporaryDirectory(prefix="rack-picture-") as folder:
            files = find_viewer_files(run)
            if not files:
                files = [Path(folder, FILE)]
                merge_runs([run], files[0])
            drawn = draw_picture(files, at, view)
        path.write_bytes(drawn.png)
    notes = drawn.complaints
    document = {"picture": str(path), "at_s": at, "view": view, "notes": notes}
    print_answer(document, "\n".join([f"picture: {path}", *notes]), as_json)
    if notes:
        raise SystemExit(1)
