"""Starting a rack, showing it while it runs, and ending it with a verdict."""
