"""The network as a bus adapter: mailboxes of a rack exported to other racks, and theirs imported
(section 3.3).
"""
