"""`rack reproduce`: go through the paper, with predictions and measurements of this machine."""

from __future__ import annotations

import sys
from importlib.util import find_spec
from pathlib import Path

from rack.tools.console.answer import Failure, print_answer
from rack.tools.console.interrupt import INTERRUPT
from rack.tools.console.parameters import Json, option
from rack.tools.launch.folder import RUNS

DEFAULT_FOLDER = RUNS / "paper"
"""Default folder of the page. It is fixed, so that a repeated command continues in it."""
MISSING_JINJA2 = "the page needs jinja2: pip install 'nasrem-rack[lab]'"
CONTINUE_HINT = "{}: finished experiments are kept; the same command continues from there"


def reproduce(
    out: Path = option(
        "--out DIR", "folder of the page; an existing one is continued", DEFAULT_FOLDER
    ),
    only: list[str] = option(
        "--only SECTION", 'only this section, as in 3.4 or "abstract"; repeatable', []
    ),
    share: bool = option(
        "--share",
        "run even on cores of another rack's real-time boards, at the price of worse figures",
        False,
    ),
    as_json: Json = False,
) -> None:
    """Reproduce the paper on this machine, and write a page that goes through it claim by claim.

    The paper is NISTIR 90-4251 (1990). Each claim, equation and figure is quoted, with the
    prediction of the timing model, the measurement with real processes, and a ruling: it holds; it
    holds here, within bounds; the paper contradicts itself; it is not testable here; or it does not
    hold here.

    The page is DIR/index.html and, as Markdown, DIR/README.md. Figures are drawn as text.
    DIR/paper.json has everything as data. DIR/runs has the recordings, for `rack report`, `rack
    gantt` and `rack analyze`.

    Every ruling results from comparisons of measured values, which the page lists. A run in which a
    claim cannot be observed, such as one in which a level made no plan, counts neither for nor
    against it.

    The experiments take eleven minutes on two cores. Do not use the machine during this time,
    because other load distorts the real-time figures. Finished experiments are kept, even if the
    command is interrupted or killed; the same command continues. After a change of configs, program
    or machine the experiments that depend on it are repeated. To repeat others, choose another DIR.

    Exit status: 0 all experiments were completed, and no claim failed; 1 otherwise; 2 usage error.

    \b
    Examples:
      rack reproduce
      rack reproduce --out paper --only 3.4
      rack reproduce --json | jq .rulings
    """
    if not find_spec("jinja2"):
        raise Failure(MISSING_JINJA2, 2)
    from rack.tools.console.progress import open_progress
    from rack.tools.lab.reproduction import reproduction
    from rack.tools.lab.reproduction.experiments.experiment import Workshop

    wanted = reproduction.select_sections(only)
    if out.exists() and not out.is_dir():
        raise Failure(f"--out {out}: exists, and is not a folder", 2)
    with (
        INTERRUPT.stop_orderly(INTERRUPT.end_process, unfinished=CONTINUE_HINT.format(out)),
        open_progress(as_json) as progress,
    ):
        page = reproduction.reproduce_paper(wanted, Workshop(out, share), progress)
    is_good = reproduction.has_succeeded(page, wanted)
    document = {"folder": str(out), "worked": is_good, **page.to_document()}
    print_answer(document, reproduction.summarize_page(page, out), as_json)
    sys.exit(0 if is_good else 1)
