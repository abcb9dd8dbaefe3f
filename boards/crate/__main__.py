"""The crate's process: see `rack.boards.crate.crate`."""

import gc

# All that is imported and preloaded from here on stays: looking for garbage in it takes a tenth of
# the launch.
gc.disable()

from rack.boards.crate.crate import main  # noqa: E402

if __name__ == "__main__":
    main()
