"""Mailboxes in shared memory: one writer, any number of readers, and their histories."""
