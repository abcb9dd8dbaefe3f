"""Entry point of the crate's process: see `rack.boards.crate.crate`."""

import gc
import os

# Everything imported and preloaded from here on stays in memory. Looking for garbage in it would
# take a tenth of the launch.
gc.disable()

from rack.boards.crate.crate import main  # noqa: E402

if __name__ == "__main__":
    main()
    # Freeing all objects at the end of the interpreter takes longer than ending the boards.
    os._exit(0)
