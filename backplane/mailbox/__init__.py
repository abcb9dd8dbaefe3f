"""Mailboxes: slots, readers, writers and protocols that determine when messages become visible."""
