"""Network adapter: exports mailboxes of a rack to other racks and imports theirs.

A network is treated as one more bus adapter (section 3.3 of the paper).
"""
