"""A run of a rack: launched and watched, recorded into its folder, read back and reported."""
