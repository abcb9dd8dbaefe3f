"""Starting a rack, and ending it with a verdict."""
