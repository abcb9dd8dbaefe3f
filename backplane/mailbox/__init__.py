"""Mailboxes: slots, readers, writers and the protocols that decide visibility."""
