"""What only racks other than NASREM's have: other historical systems, force, hands, work shared by
racks.
"""
