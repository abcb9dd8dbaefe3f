"""A client on another machine, as a program: runs `rack` commands one after the other, each as its
own process would.

`python -m tests.tools.network.client WORDS...`, each a JSON list, prints a JSON list: status,
stdout, stderr of each. What they need of the network is imported once, and no process is forked
from one that has the network's threads.
"""

from __future__ import annotations

import json
import os
import sys

from tests.tools.command_line import rack

if __name__ == "__main__":
    done = [rack(*json.loads(words)) for words in sys.argv[1:]]
    sys.stdout.write(json.dumps([[one.returncode, one.stdout, one.stderr] for one in done]))
    sys.stdout.flush()
    os._exit(0)
