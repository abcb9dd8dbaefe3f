"""The commands of `rack`, one file each."""
