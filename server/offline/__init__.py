"""The servo's tick without its clock, and what is kept and drawn of a run.

Nothing here needs a device or real time.
"""
