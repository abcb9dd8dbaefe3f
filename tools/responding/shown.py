"""What `rack analyze RUN --response` shows of a run."""

from __future__ import annotations

import json
from pathlib import Path

from rack.tools.console.answer import Failure, print_json
from rack.tools.console.tables import print_wrapped, terminal_width
from rack.tools.recording import Recording
from rack.tools.responding.plot import plot
from rack.tools.responding.response import response_of


def show(recording: Recording, folder: Path, as_json: bool) -> bool:
    """Print the response of a run and write response.json and its pictures into `folder`; return whether it held.

    Raises `Failure` where no operator commanded a level.
    """
    response = response_of(recording)
    if response is None:
        why = "no operator commanded a level of its hierarchy"
        raise Failure(f"{recording.folder}: {why}; see 'rack command', [[command]] and 'rack bench response'", 2)
    folder.mkdir(parents=True, exist_ok=True)
    document = response.document()
    (folder / "response.json").write_text(json.dumps(document, indent=2) + "\n")
    paths = plot(response, folder)
    if as_json:
        print_json(document)
    else:
        files = f"{folder}/response.json, {', '.join(path.name for path in paths)}"
        print_wrapped(f"{response.text(terminal_width())}\n\n{files}")
    return response.held
