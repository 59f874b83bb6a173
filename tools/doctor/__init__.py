"""`softfinger doctor`: whether this machine is good enough, and a report of a device that an issue can carry.

Nothing here mends: it tells what would.
"""
